"""Device side of spadrig: interfaces, errors, units, SPB1 blocks, the block ring and the registry of kinds.

Input: configs of devices, and what a scan asks of them in SI units. Output: packed binary frames in the ring, light,
motion and pulses, and the devices' states and errors. `interfaces` says what a device can do. `lasers`, `scanners`,
`spads` and `sync` are real devices, `replay` plays a recording, and `guard` can switch the light off by itself.
"""
