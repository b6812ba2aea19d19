"""The calibrated rig as numbers: camera, light planes, lags, their covariance; and where light meets a ray."""
