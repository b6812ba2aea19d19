"""A recording in place of the devices.

`spad` plays the frames, `stand_ins` play the other devices, `pace` keeps the clock.
"""
