"""Reading and writing of calibration.yaml and camera.yaml.

Input: a file, or a model to be written. Output: a rig model or a camera, or the file; `FileError` with a line for each
problem if the file is wrong. Other YAML files, such as configs and scenes, are read with `sections` and `problems` too.
"""
