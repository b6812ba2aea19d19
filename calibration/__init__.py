"""The rig model of spadrig and its mathematics: camera, light planes, triangulation, and the calibration file.

Input: pictures of a board, counts of sweeps and of dark frames, calibration files. Output: a rig model with its
covariance and a verdict on it, the lags, and a map of the pixels. Mostly functions of arrays; no module keeps state,
and nothing else of the project is imported. Parts import only parts named before them, and `arrays`, `errors`, `views`,
`verdict`. `model`, `depth_error`: the rig and the effect of errors on depth. `files`: reads and writes the calibration
file. `board`, `pixel_map`, `passages` and `sync`: from frames to numbers. `camera_fit`, `rig_fit`, `check` and `guide`:
from these numbers to a model, its check, and advice on further views. `diagnosis`: judges the result.
"""
