"""Judges a fitted calibration, and names the mistake behind one that failed.

Input: a fit with its covariance, and the views it was made from. Output: a `calibration.verdict.Verdict` with reasons.
`rules` holds the evidence and the limits, `contradictions` the numbers that distinguish a moved rig from waves.
"""
