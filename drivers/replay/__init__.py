"""A recording in place of the devices: `spad` plays the frames, `stand_ins` replace the others, `pace` keeps time.

Input: the folder of a recording, and how fast to play it. Output: a `SpadArray` that fills the ring with the recorded
frames, and a scanner, laser and sync source that accept every call and do nothing.
"""
