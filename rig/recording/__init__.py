"""Recordings: files of SPB1 blocks (segments, docs/reference/spb1.md) and their index; writing, checking, repairing.

`writer` writes and `open` opens them, `replay` plays them; `verify`, `repair`, `cut` and `compress` are the commands.
"""
