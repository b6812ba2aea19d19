"""Measures what accuracy costs in time (`rig tradeoff`) and what the effects of a scene are worth (`rig effects`).

Enters: the config of a simulated rig, and the settings to try. Leaves: a table of error over time, the limits that
photon statistics set (`limits`, `row_light`), and the setting to use (`choice`).
"""
