"""Who may let light out: a real laser or gate needs the user's word, a simulated one none."""

from drivers.registry import KindConfig
from drivers.transports.endpoints import EMULATED_PREFIX
from rig.config import RigConfig


def require_simulated_or_armed(config: RigConfig, arm: bool) -> list[str]:
    """Problems with letting light out: every real laser and gate needs the user's word."""
    real = [slot for slot in ("laser", "sync") if not _made_here(getattr(config, slot))]
    if arm or not real:
        return []
    kinds = ", ".join(f"{slot} {getattr(config, slot).kind}" for slot in real)
    return [f"{config.name} has real light ({kinds}); clear the beam path, then add --arm"]


def _made_here(device: KindConfig) -> bool:
    """Whether a device shines no real light: simulated, or at a port that this process emulates."""
    return not device.real_time or str(getattr(device, "port", "")).startswith(EMULATED_PREFIX)
