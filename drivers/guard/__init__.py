"""The guard: a small process that owns the ports of laser and gate, and ends the light when the application cannot.

    with Guard(laser=config.laser, sync=config.sync, ports=ports) as guard:
        laser, sync = guard.laser, guard.sync      # a LineLaser and a SyncSource like any other
        ...                                        # on the source thread, for every block:
        guard.beat(last_frame_number)

Between `sync.run()` and the low gate the guard wants to see frame numbers change. Gone, stopped or hung, an application
loses its light within 100 ms and its life after that; `GuardLimits` says what counts as hung.
"""

from drivers.guard.client import Guard
from drivers.guard.watch import GuardLimits

__all__ = ["Guard", "GuardLimits"]
