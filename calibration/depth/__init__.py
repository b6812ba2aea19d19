"""What errors of a calibration, a command or a pixel are worth in depth."""
