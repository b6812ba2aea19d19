"""The folder of a run: maps, pictures, clouds, manifest, summary. Without a recording it appears whole or not at all.

Input: maps, the truth if there is one, and an account of the run. Output: the files. `folder` writes them, `pictures`
draws, `manifest`, `summary` and `time_of_day` make what the two JSON files say. `map_files` reads maps again, `runs`
lists runs, and `joined` makes one run of several.
"""
