"""From stripe positions to depth: triangulation on the camera's grid, and the density of the fog from its haze.

Input: a stripe table and the geometry of the sweep. Output: depth in metres per camera pixel, and the extinction.
"""
