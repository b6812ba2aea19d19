"""Exchange of recordings with other programs: `rig import`, `rig export` (docs/how-to/exchange.md).

Input: files with another program's frames, or the folder of a run. Output: a recording (`importing`); or arrays, one
HDF5 file, point clouds, pictures or a film (`exporting`).
"""
