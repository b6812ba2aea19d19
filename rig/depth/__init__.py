"""Stripe positions to depth: triangulation on the camera's grid, and the fog that a map's haze tells.

Enters: a stripe table, the geometry of the sweep. Leaves: depth in metres per camera pixel, and the extinction.
"""
