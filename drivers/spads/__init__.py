"""SPAD arrays: the SPAD512S over TCP, and any sensor that streams SPB1 blocks over USB."""
