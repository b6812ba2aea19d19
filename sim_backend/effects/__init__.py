"""Effects on laser light, other light and the sensor's bits. A module is imported only if a scene has its effect."""
