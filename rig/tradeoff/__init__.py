"""What accuracy costs in time: `rig tradeoff` and `rig effects`.

Enters: the config of a simulated rig, and the settings to try. Leaves: a table of error over time, the limits that
photon statistics set (`limits`, `row_light`), and the setting to use (`choice`).
"""
