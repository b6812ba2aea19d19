"""The calibration board: its print, and how its corners are found in a picture.

Input: the board's file, and a picture from counts or from an image file. Output: a `Board`, and its corners as
`calibration.views.Corners`: number, pixel and standard deviation of each; or the reason why there are none.
"""
