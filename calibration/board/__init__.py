"""The calibration board: its print, its corners in a picture, and how much of the picture they cover."""
