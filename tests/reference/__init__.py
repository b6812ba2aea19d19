"""Independent yardstick: a second simulator of fog pictures and a genie that is told what the estimators must learn.

Geometry, scenes, light and genie share no code with sim_backend, rig or calibration: a mistake made there must not be
made here as well. `adapter` alone hands their counts to the project; `house` and `identity` look at the tree and at
what its commands compute.
"""
