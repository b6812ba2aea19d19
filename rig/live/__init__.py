"""A run seen from other processes: the shared slot with its newest values, and the feed that fills it.

Viewers and streams read the slot; nothing that they do or fail to do can delay the run.
"""
