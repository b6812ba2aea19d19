"""Ordinary ends of every command: Ctrl-C, a closed terminal or pipe, a full disk, an output folder that goes away.

Commands are called and judged as a user would: by what is on the terminal and on the disk, and what `rig verify`,
`rig runs` and `rig report` say about it.
"""
