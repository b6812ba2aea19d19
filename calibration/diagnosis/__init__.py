"""Judges a fitted calibration, and names the mistake behind one that failed.

Enters: a fit with its covariance, and the views it was made of. Leaves: a `calibration.verdict.Verdict` with reasons.
`rules` holds the limits, `evidence`, `sweep_waves` and `view_shifts` the numbers that tell one mistake from another.
"""
