"""A scan from open devices to its folder, and its replay from a recording.

Input: a rig and a request. Output: maps, one after the other, and an account of every frame. `scan` prepares a scan,
runs it and reports how it went. `acquisition` starts and stops the devices. `source` fills the ring, a buffer of blocks
of frames, `pipeline` moves the blocks between threads, and `counting` makes maps of them. `estimator` chooses the
estimator, `run` keeps the maps, `monitor` tells listeners about progress. `reconstruct` makes maps from a cube (frames
without markers), `replay` from a recording; `control_check` compares what drivers sent during a replay.
"""
