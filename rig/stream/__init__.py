"""A stream of depth maps for other programs, over TCP (`rig stream`): its messages, and the server that sends them.

Input: the slot (`rig.live.slot`) of this user's newest running scan. The server is a separate process, so that no
client can delay the scan. The format is in docs/reference/depth-stream.md.
"""
