"""Recordings: files of SPB1 blocks (segments, docs/reference/spb1.md) and their index; writing, checking, repairing.

Input: the blocks of a scan, or a recording. Output: a recording, or what it holds and what is damaged. `writer` writes
and `open` opens them, `replay` plays them; `verify`, `repair`, `cut` and `compress` are the commands.
"""
