"""The calls about a rig and its computer: check a config, examine or list devices, laser off, speed, compilation."""

from pathlib import Path
from typing import TYPE_CHECKING

from rig.config.models import MOST_THREADS, RigConfig
from rig.config.overrides import SIMULATED, Config, PathLike, configure
from rig.errors import UsageError
from rig.progress import Progress

if TYPE_CHECKING:
    from rig.bench.speed import SpeedReport
    from rig.devices.doctor import Attached, Finding


def check_config(config: Config = SIMULATED) -> RigConfig:
    """Load a config, open every file that it names as a scan would, and return the config (`rig config check`).

    Raises UsageError with one line per problem.
    """
    from rig.devices.open import check_files

    checked = configure(config)
    check_files(checked)
    return checked


def doctor(config: Config = SIMULATED, *, out: PathLike = "runs") -> "list[Finding]":
    """Examine whether a scan could run: devices, plan, frames, markers, dark counts and disk (`rig doctor`).

    The mirror moves, but the laser stays dark. out: folder where a scan would write.
    """
    from rig.devices.doctor import examine

    return examine(configure(config), Path(out))


def devices() -> "list[Attached]":
    """List USB devices that a driver knows, NI cards, Ether Dreams, Pulse Streamers and serial ports, without opening
    any (`rig devices`)."""
    from rig.devices.doctor import attached

    return attached()


def laser_off(config: Config = SIMULATED) -> list[str]:
    """Set the gate low, disarm the laser, and return lines that say what was done (`rig laser off`).

    Both are tried even if one fails. Raises DevicesError if a device fails or does not answer, or if the laser can only
    be switched off by hand; UsageError if the config has problems; DeviceError if the config's world cannot be made.
    """
    from rig.devices.doctor import laser_off as switch_off

    return switch_off(configure(config))


def bench(*, threads: int | None = None, progress: Progress | None = None) -> "SpeedReport":
    """Measure how fast this machine counts and estimates, within a minute (`rig bench`).

    threads: the largest number of threads to measure with, 1 to 256; None is one for each core. Raises UsageError for
      any other number.
    progress: called with the number of rows done and the total, over all rounds.
    """
    from rig.bench.speed import measure_speed

    if threads is not None and not 1 <= threads <= MOST_THREADS:
        raise UsageError(f"threads is {threads}; it must be at least 1 and at most {MOST_THREADS}")
    return measure_speed(threads, progress=progress)


def warm_up(config: Config = SIMULATED) -> float:
    """Compile every kernel that a scan with this config can need and return the seconds it took (`rig warmup`).

    Real devices are not opened.
    """
    from rig.bench.warm_up import warm_rig

    return warm_rig(configure(config))
