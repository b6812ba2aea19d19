"""The folder of a run: maps, pictures, clouds, manifest, summary. Without a recording it appears whole or not at all.

`folder` writes the files, `pictures` and `charts` draw, `manifest` and `summary` hold what the two JSON files say.
"""
