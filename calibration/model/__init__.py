"""The calibrated rig as numbers: camera, light planes, lags and their covariance; and where light meets a ray.

Input: the numbers of a calibration. Output: a `RigModel`, which gives the ray of each pixel and the light plane of each
mirror command, and the depth in metres at which the two meet. `parameters` lists the numbers of a model for fits.
"""
