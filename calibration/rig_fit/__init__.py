"""One robust fit of camera, poses, mirror and lags to all views, with the joint covariance of all parameters."""
