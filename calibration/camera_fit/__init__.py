"""The camera alone from the corners of many views."""
