"""A run seen from other processes: a file with its newest values (the slot), and the feed that fills it.

Viewers and streams read the slot; nothing that they do or fail to do can delay the run.
"""
