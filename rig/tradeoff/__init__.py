"""Measures what accuracy costs in time (`rig tradeoff`) and how much the effects of a scene matter (`rig effects`).

Input: the config of a simulated rig, and the settings to try. Output: a table of error over time, the limits that
photon statistics set (`limits`, `row_light`), and the setting to use (`choice`).
"""
