"""The simulated devices. They have the interfaces of the real ones and share one `sim_backend.bench.Bench`.

Input: their configs and the calls of a scan. Output: blocks of frames from the SPAD; power, mirror motion and gate of
the others, which they report to the bench.
"""
