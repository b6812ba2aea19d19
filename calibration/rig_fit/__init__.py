"""One robust fit of camera, poses, mirror and lags to all views, with the joint covariance of all parameters.

Input: a board and views of it, with corners and passages. Output: a `RigFit`: the rig model, the poses of the board,
the residuals, and the views that were left out. Begin reading at `fit`.
"""
