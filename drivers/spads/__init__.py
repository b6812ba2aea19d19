"""SPAD arrays: the SPAD512S over TCP, and any sensor that streams SPB1 blocks over USB.

A driver takes a capture request and fills a `drivers.ring` with blocks of frames.
"""
