"""A scan from open devices to its folder, and its replay from a recording.

Enters: a rig and a request. Leaves: maps, one after the other, and an account of every frame. `scan` prepares it,
runs it and says how it went; `acquisition` starts and stops the devices, `source` fills the ring, `pipeline` moves
blocks between threads, `counting` makes maps of them, `run` keeps them. `reconstruct` and `replay` do the same from a
cube or a recording.
"""
