"""The calibrated rig as numbers: camera, light planes, lags and their covariance; and where light meets a ray."""
