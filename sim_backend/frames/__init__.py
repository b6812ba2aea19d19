"""From light to frames: the flux of every pixel, and packed one-bit frames drawn from it."""
