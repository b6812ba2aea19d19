"""A recording in place of the devices: `spad` plays the frames, `stand_ins` the others, `pace` keeps the clock."""
