"""Effects on the light between laser and sensor, one file each; one that no scene calls for is not imported."""
