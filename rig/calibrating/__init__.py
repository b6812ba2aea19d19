"""`rig calibrate`: takes views of a board with a live, simulated or recorded rig and makes a calibration of them."""
