"""Frames to counts: binds each frame to its column and sweep, and adds up detections without unpacking a bit.

Enters: blocks of packed frames and the scan plan. Leaves: for every sweep the counts of each row, pixel and column,
with the number of frames behind them and an account of what was lost.
"""
