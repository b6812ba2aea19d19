"""What light does between laser and sensor, one file per effect; what a scene does not call for is not imported."""
