"""The fast search for the best position of a row, tested against the exact likelihood, `rig.estimate.row.likelihood`.

Sixteen rows or pixels at a time in 16-bit scores, then a close look at the best place of each row. `stream` judges
columns while the sweep still goes on; `online_learning` keeps the learned model between maps.
"""
