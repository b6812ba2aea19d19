"""The compiled scan: mirror command, gate, markers and sensor windows over time, checked against all devices' limits.

Input: config, calibration, limits of scanner and sensor. Output: a `rig.plan.scan_plan.ScanPlan`, which says for every
frame time where the mirror is. `compile` makes it.
"""
