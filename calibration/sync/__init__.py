"""Lags, row delay and gate delay from a scene that stands still.

Input: passages of several sweeps (`lag_fit`), or the ones of each frame at the ends of sweeps (`gate_fit`). Output:
lags and row delay, a rig model with them (`transfer`), and the time at which light begins or ends, each with its error.
"""
