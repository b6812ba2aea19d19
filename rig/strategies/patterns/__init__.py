"""Strategies that show patterns one after the other: binary and Gray codes, phase shift, error-correcting codes.

Patterns vary along the columns of the projector, and a pixel's column follows from what it sees of each pattern.
"""
