"""Costs of the labels (candidate positions) of every row and column, in bytes: a fast form of the row likelihood.

Input: the counts of a sweep, its geometry and a row model. Output: costs, uint8 (rows, columns, labels).
`grid` defines the position of each label, `tables` holds the terms of `rig.estimate.row.likelihood`, `costs` computes
the costs of a sweep. tests/unit/rig/estimate/joint/test_label_volume.py compares them with log-likelihoods in numpy.
"""
