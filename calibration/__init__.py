"""The rig model and its mathematics: camera, light planes, triangulation, and the calibration file.

Functions of arrays, without state. This package imports nothing else of the project. Each of its parts imports only
parts named before it, and `arrays`, `errors`, `views` and `verdict`. `model` and `depth_error`: the rig, and the effect
of errors on depth. `files`: reads and writes the calibration file. `board`, `pixel_map`, `passages` and `sync`: from
frames to numbers. `camera_fit`, `rig_fit`, `check` and `guide`: from these numbers to a model, its check, and advice on
further views. `diagnosis`: judges the result.
"""
