"""From light to frames: the flux of every pixel, and packed one-bit frames drawn from it.

Input: the effects of a scene; mirror position, laser power and time of each frame; a seed. Output: packed bits, uint8
(frames, rows, row bytes). `flux` adds up the light, `photons` draws the frames.
"""
