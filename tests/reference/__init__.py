"""Independent yardstick: a second simulator of fog pictures and a genie that is told what the estimators must learn.

Shares no code with sim_backend, rig or calibration: a mistake made there must not be made here as well.
"""
