"""The devices of a rig as a whole: open and close them together, check them, and match them with a calibration.

`open` opens them, `prepare` makes the plan of a scan with them, `calibration_use` compares a calibration with them, and
`doctor` reports whether a scan could run.
"""
