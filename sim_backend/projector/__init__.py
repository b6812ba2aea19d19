"""Light sources other than the scanned line (patterns, spots, flashes, ambient light), and the cameras that see them.

Input: a world's rig and effects, and the rows of the picture that are measured. Output: an apparatus that shows
patterns and counts photons (`SimulatedWorld.apparatus`), and adds up the time and energy used.
"""
