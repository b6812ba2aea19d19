"""A stream of depth maps for other programs, over TCP (`rig stream`): its messages, and the server that sends them.

Input: the slot of the newest running scan of this user. It runs in a process of its own, so that no client can delay
the scan. The format is in docs/reference/depth-stream.md.
"""
