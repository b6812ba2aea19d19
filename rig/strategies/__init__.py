"""Other ways to measure depth, beside the line scan of this program, simulated on the same scene for comparison.

A strategy gets an `Apparatus` (light source, camera, scene), a budget of time and the geometry, and returns a depth map
with a confidence. `compare` runs many of them and scores all in the same way.
"""
