"""The folder that a run leaves, which appears whole or not at all: maps, pictures, clouds, manifest and summary.

`folder` writes the files, `pictures` and `charts` draw, `manifest` and `summary` hold what the two JSON files say.
"""
