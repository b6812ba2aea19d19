"""A scan from open devices to its folder, and its replay from a recording.

Input: a rig and a request. Output: maps, one after the other, and an account of every frame. `scan` runs it;
`acquisition` starts and stops the devices, `pipeline` moves blocks between threads, `counting` makes maps from them.
"""
