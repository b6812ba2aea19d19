"""The sessions of `rig calibrate`: take views of a board or dark frames, fit, judge, write a folder with a report.

Input: a rig, or views taken before. Output: calibration.yaml, camera.yaml or a pixel map, with its verdict. The
mathematics is in the package `calibration`; this package has the scans, the files and the reports. `align` is the
command `rig align`, which helps to set a rig up.
"""
