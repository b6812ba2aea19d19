"""A recording in place of the devices: `spad` plays the frames, `stand_ins` replace the other devices, `pace` keeps
time.
"""
