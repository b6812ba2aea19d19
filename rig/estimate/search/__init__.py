"""The fast search for the best position of a row under the likelihood of `rig.estimate.row.likelihood`.

Sixteen rows or pixels at a time in 16-bit scores, then an exact close look at the best places. `stream` judges
columns while the sweep still goes on; `online_learning` keeps the learned model between maps. Only who tunes speed
needs to open this package.
"""
