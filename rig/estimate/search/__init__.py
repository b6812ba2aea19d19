"""The fast search for the best position of a row, tested against the exact likelihood, `rig.estimate.row.likelihood`.

Input: a row model, and the frames of a sweep or its counts. Output: a stripe table, and the counts to learn from.
Sixteen rows or pixels at a time are scored in 16 bits, then the best position of each row is examined closely. To judge
a column is to estimate its stripe on every row: `stream` does so while the sweep still goes on. Everything here is for
speed.
"""
