"""Cameras of every lens model that OpenCV defines, for the tests of this folder."""

import numpy as np

from calibration.model.camera import Camera

MATRIX = np.array([[600.0, 0, 255.5], [0, 600.0, 255.5], [0, 0, 1]])

LENSES: dict[str, list[float]] = {
    "ideal": [],
    "4 terms": [-0.2, 0.05, 0.001, -0.002],
    "5 terms": [-0.35, 0.1, 0.001, -0.002, 0.01],
    "8 terms": [-0.1, 0.02, 0.001, 0.002, 0.0, 0.01, 0.02, 0.03],
    "12 terms": [-0.3, 0.1, 0.001, 0.001, 0.0, 0.1, 0.1, 0.0, 0.01, 0.02, -0.01, 0.01],
    "14 terms": [-0.3, 0.1, 0.001, 0.001, 0.0, 0.1, 0.1, 0.0, 0.01, 0.02, -0.01, 0.01, 0.05, -0.03],
    "strong barrel": [-0.35, 0.0, 0.0, 0.0],
    "pincushion": [0.3, 0.1, 0.0, 0.0],
}


def camera(terms: list[float], width: int = 512, height: int = 512) -> Camera:
    """A camera of f = 600 px with these distortion terms."""
    return Camera(width, height, MATRIX, np.array(terms))
