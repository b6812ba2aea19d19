"""Sub-pixel positions of stripes, from their own counts and those of neighbours on the same surface.

Input: counts, a row model, and the positions of the answers. Output: refined positions with their standard deviations,
and light and haze of each stripe, all float32 (rows, columns); the width of the line. Begin reading at `place`.
"""
