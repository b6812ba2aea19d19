"""The devices of a rig as a whole: open and close them together, check them, and match them with a calibration.

Input: a rig's config. Output: the open devices, a plan that they can play, and the reasons against a scan or a
calibration. `open` opens the devices, `prepare` makes the plan, `calibration_use` compares a calibration with them, and
`doctor` reports whether a scan could run.
"""
