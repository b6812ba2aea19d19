"""Ways to measure depth other than the line scan of this program, simulated on the same scenes for comparison.

A strategy gets an `Apparatus` (light source, camera, scene), a budget of time and the geometry, and returns a depth map
with a confidence. `compare` runs many of them and scores all in the same way.
"""
