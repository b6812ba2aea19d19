"""The calibration board: its print, and how its corners are found in a picture."""
