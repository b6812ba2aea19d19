"""A finished calibration against boards that it was not made of."""
