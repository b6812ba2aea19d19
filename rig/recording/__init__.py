"""Recordings: folders with segments (files of SPB1 blocks, docs/reference/spb1.md) and their index.

Input: the blocks of a scan, or a recording. Output: a recording, or what it holds and what is damaged. `writer` writes
recordings, `open` opens them, and `replay` plays them. `verify`, `repair`, `cut` and `compress` are commands.
"""
