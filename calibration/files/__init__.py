"""calibration.yaml and camera.yaml, read and written."""
