"""The devices of a rig as a whole: opened and closed together, checked, looked at in the dark, matched with a
calibration.
"""
