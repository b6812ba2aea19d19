"""From frames to counts: assigns each frame to a sweep and column, and adds up detections without unpacking bits.

Input: the plan, and blocks of packed frames. Output: for each sweep the counts of every pixel and column, and an
account of its frames, the lost ones included. `bind` and `blanking` find the columns, `volume` counts, `sweeps` does
both block by block, `map_checks` tests a map by its own light.
"""
