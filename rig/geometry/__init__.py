"""The geometry of a sweep: search windows of every row and column from calibration and depth range, bent light sheets,
the columns of several lines, and the stripe table.
"""
