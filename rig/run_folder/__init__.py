"""The folder that a run leaves: maps, pictures, point clouds, manifest and summary, written so that it appears whole or
not at all.
"""
