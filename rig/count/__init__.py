"""Frames to counts: binds each frame to its column and sweep, and adds up detections without unpacking a bit."""
