"""The guard: a small process that owns the ports of laser and gate, and ends the light if the application cannot.

    with Guard(laser=config.laser, sync=config.sync, ports=ports) as guard:
        laser, sync = guard.laser, guard.sync      # a LineLaser and a SyncSource like any other
        ...                                        # on the source thread, for every block:
        guard.beat(last_frame_number)

Input: the configs of laser and sync source, and the number of the last frame. Output: the two devices. Between
`sync.run()` and the moment the gate goes low, the guard expects the frame number to keep changing. If the application
has ended, was stopped or hangs, the guard switches the light off (within 100 ms if all threads of the application
sleep), and kills an application that does not make its rig safe by itself. `GuardLimits` says what counts as hanging.
"""

from drivers.guard.channel import require_linux
from drivers.guard.client import Guard
from drivers.guard.watch import GuardLimits

__all__ = ["Guard", "GuardLimits", "require_linux"]
