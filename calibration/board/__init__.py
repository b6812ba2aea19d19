"""The calibration board: its print, its corners in a picture, what of the picture it covers."""
