"""The simulated rig of spadrig: worlds, effects, photons and simulated devices.

Input: a scene, the geometry of a rig, and what its devices do over time. Output: packed one-bit frames as from a real
SPAD and, once an estimate is complete, the truth of a sweep. Begin reading at `world`.
"""
