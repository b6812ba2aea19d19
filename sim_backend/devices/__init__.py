"""The simulated devices: peers of the real ones, sharing one bench."""
