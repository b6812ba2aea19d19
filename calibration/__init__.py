"""The rig model and its mathematics: camera, light planes, triangulation, and the calibration file.

Functions of arrays, without state. This package imports nothing else of the project. Besides `arrays`, `errors`,
`views` and `verdict`, each of its parts uses only those named before it. `model` and `depth_error` hold the rig and the
effect of errors on depth; `files` reads and writes it;
`board`, `pixel_map`, `passages` and `sync` turn frames into numbers; `camera_fit`, `rig_fit`, `check` and `guide` turn
these into a model and advice on further views; `diagnosis` judges the result.
"""
