"""The simulated rig of spadrig: worlds, effects, photons and simulated devices.

Input: a scene, the geometry of a rig, and what its devices do over time. Output: packed one-bit frames as from a real
SPAD, and the truth of a sweep, which estimates are compared with. Begin reading at `world`.
"""
