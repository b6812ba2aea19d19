"""The devices of a recorded run, for its manifest: what they are and what they were set to."""

from typing import Any

from drivers.interfaces import SpadTiming
from rig.recording.plain import to_plain
from rig.scan_plan import ScanPlan
from rig.session import OpenRig


def devices_content(rig: OpenRig, plan: ScanPlan, timing: SpadTiming) -> dict[str, Any]:
    """Identity, limits and timing of each; `from_plain` reads `SpadInfo`, `SpadTiming` and the limits back."""
    kinds = {slot: getattr(rig.config, slot).kind for slot in ("spad", "scanner", "laser", "sync")}
    return {
        "spad": {
            "kind": kinds["spad"],
            "name": rig.spad.name,
            "info": to_plain(rig.spad.info),
            "timing": to_plain(timing),
        },
        "scanner": {
            "kind": kinds["scanner"],
            "name": rig.scanner.name,
            "limits": to_plain(rig.scanner.limits),
            "point_rate_hz": to_plain(plan.point_rate_hz),
        },
        "laser": {"kind": kinds["laser"], "name": rig.laser.name, "limits": to_plain(rig.laser.limits)},
        "sync": {"kind": kinds["sync"], "name": rig.sync.name},
    }
