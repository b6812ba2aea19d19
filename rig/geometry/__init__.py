"""Where a stripe can lie: windows of every row and column from the calibration and the depth range, bent light sheets,
lines of a fan.
"""
