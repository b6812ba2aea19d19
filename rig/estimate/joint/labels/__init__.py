"""Costs of the labels (candidate positions) of every row and column, in bytes: a fast form of the row likelihood.

`grid` says which position a label is, `tables` holds the terms of `rig.estimate.row.likelihood`, `costs` gives the
costs of a sweep. tests/unit/rig/estimate/joint/test_label_volume.py compares them with log-likelihoods in numpy.
"""
