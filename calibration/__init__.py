"""The rig model and its mathematics: camera, light planes, triangulation, and the calibration file.

Pure functions on arrays. This package imports nothing else of the project.
"""

from calibration.camera import Camera
from calibration.covariance import Covariance
from calibration.errors import CalibrationError
from calibration.files import load_rig_model, save_rig_model
from calibration.model import Identity, Lag, RigModel
from calibration.scanner import PivotScanner, PlaneTable, Scanner

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
