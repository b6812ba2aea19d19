"""Recordings: SPB1 segments with an index, written while a run goes on; reading, checking and repairing them.

`writer` writes and `open` opens them, `replay` plays them; `verify`, `repair`, `cut` and `compress` are the commands.
"""
