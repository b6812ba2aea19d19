"""Effects on the light between laser and sensor; a module that no scene calls for is not imported."""
