"""From counts to stripe positions: the estimators `argmax`, `edge`, `likelihood` and `joint`, and the median filter.

Input: the counts of a sweep and its geometry. Output: a stripe table. Read `rig.estimate.row.likelihood` first: it is
the specification, the exact likelihood of one row. `search` finds the best position of a row fast, `joint` estimates
rows and columns together. `online_learning` keeps the learned model from map to map; `registry` makes an estimator,
given its name.
"""
