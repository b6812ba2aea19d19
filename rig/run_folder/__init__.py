"""The folder of a run: maps, pictures, clouds, manifest, summary. Without a recording it appears whole or not at all.

Input: maps, the truth if there is one, and an account of the run. Output: the files. `folder` writes them, `pictures`
and `charts` draw, `manifest` and `summary` hold what the two JSON files say.
"""
