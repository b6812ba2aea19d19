"""The rig model and its mathematics: camera, light planes, triangulation, and the calibration file.

Pure functions on arrays. This package imports nothing else of the project. Its parts, each knowing only those before
it: `model` and `depth_error` are the rig and what errors are worth, `files` what is written; `board`, `pixel_map`,
`passages` and `sync` go from frames to numbers; `camera_fit`, `rig_fit`, `check` and `guide` from those to a model and
to more views; `diagnosis` says whether it will do.
"""

from calibration.errors import CalibrationError
from calibration.files.rig_file import load_rig_model, save_rig_model
from calibration.model.camera import Camera
from calibration.model.rig_model import Covariance, Identity, Lag, RigModel
from calibration.model.scanner import PivotScanner, PlaneTable, Scanner

__all__ = [
    "CalibrationError",
    "Camera",
    "Covariance",
    "Identity",
    "Lag",
    "PivotScanner",
    "PlaneTable",
    "RigModel",
    "Scanner",
    "load_rig_model",
    "save_rig_model",
]
