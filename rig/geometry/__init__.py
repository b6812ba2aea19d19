"""The geometry of a sweep: search windows, bent light sheets, the columns of several lines, and the stripe table.

Input: a rig model, the mirror command of each column, and the depth range. Output: a `SweepGeometry` with rays, planes
and search windows of every row and column. The stripe table is the form in which estimators answer.
"""
