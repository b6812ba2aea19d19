"""Effects on the light between laser and sensor. A module is imported only if a scene calls for its effect."""
