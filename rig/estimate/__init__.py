"""Counts to stripe positions: the estimators `argmax`, `edge`, `likelihood` and `joint`, and the median filter.

Enters: the counts of a sweep and its geometry. Leaves: a stripe table with position, confidence, signal and haze for
every row and column. The idea stands in `rig.estimate.row.likelihood`, the exact likelihood of one row; `search`
finds its best position fast, `joint` ties rows and columns together. `registry` finds an estimator by its name.
"""
