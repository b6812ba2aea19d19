"""Reading and writing of calibration.yaml and camera.yaml."""
