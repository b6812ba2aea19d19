"""A scan from open devices to its folder, and its replay from a recording.

Input: a rig and a request. Output: maps, one after the other, and an account of every frame. `scan` prepares a scan,
runs it and reports how it went. `acquisition` starts and stops the devices, `source` fills the ring, `pipeline` moves
blocks between threads, `counting` makes maps of them, `estimator` says with which estimator, `run` keeps the maps.
`monitor` tells listeners about progress. `reconstruct` and `replay` make maps from a cube or a recording.
"""
