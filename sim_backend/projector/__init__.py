"""Light sources other than the scanned line, and the cameras that see them: patterns, spots, flashes, ambient light.

Input: a world's rig and effects, and the rows of the picture that matter. Output: an apparatus that shows patterns and
counts photons (`SimulatedWorld.apparatus`), with an account of time and energy.
"""
