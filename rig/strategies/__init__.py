"""Ways to measure depth, the line scan of this program among them, simulated on the same scenes for comparison.

A strategy gets an `Apparatus` (light source, camera, scene), the geometry and a budget of time, and returns a depth map
with a confidence. `rig.strategies.comparison` runs many of them and scores all in the same way.
"""
