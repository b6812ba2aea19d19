"""The calls about a rig and its computer: what a scene calls for, what is attached, whether it could run, how fast."""

from pathlib import Path
from typing import TYPE_CHECKING

from rig.api_config import SIMULATED, Config, PathLike, configure
from rig.errors import UsageError
from rig.run import Progress

if TYPE_CHECKING:
    from rig.attached import Attached
    from rig.bench.disk import DiskReport
    from rig.bench.soak import SoakReport
    from rig.bench.speed import SpeedReport
    from rig.doctor import Finding
    from rig.effects import Effect


def effects(config: Config = SIMULATED, *, scene: str | None = None) -> "tuple[Effect, ...]":
    """Which effects a simulated scene calls for, why, and what leaving each out would change (`rig effects`)."""
    from rig.effects import scene_effects

    return scene_effects(configure(config, scene=scene))


def doctor(config: Config = SIMULATED, *, out: PathLike = "runs") -> "list[Finding]":
    """Whether a scan could run (`rig doctor`): devices, plan, frames, markers, dark counts, disk; no light leaves.

    The mirror moves. out: where a scan would write.
    """
    from rig.doctor import examine

    return examine(configure(config), Path(out))


def devices() -> "list[Attached]":
    """USB devices that a driver knows and serial ports, as far as can be seen without opening them (`rig devices`)."""
    from rig.attached import attached

    return attached()


def laser_off(config: Config = SIMULATED) -> list[str]:
    """Take the gate low and disarm the laser (`rig laser off`); says what was done. Raises DevicesError."""
    from rig.attached import laser_off as switch_off

    return switch_off(configure(config))


def bench(*, threads: int | None = None, progress: Progress | None = None) -> "SpeedReport":
    """How fast this machine counts and estimates, within a minute (`rig bench`).

    threads: the most to measure, by default one for each core. progress: called with rows done and all, of all rounds.
    """
    from rig.bench.speed import measure_speed

    if threads is not None and threads < 1:
        raise UsageError(f"threads is {threads}; it must be at least 1")
    return measure_speed(threads, progress=progress)


def bench_disk(folder: PathLike, *, progress: Progress | None = None) -> "DiskReport":
    """How fast recordings are written to and read from the disk of `folder`, beside what it does at its best.

    Some 2 GB are written there and removed again. progress: called with measurements done and all.
    """
    from rig.bench.disk import measure_disk

    return measure_disk(Path(folder), progress)


def soak(
    seconds: float = 60.0,
    *,
    threads: int | None = None,
    window: bool = False,
    slow_consumer_s: float = 0.0,
    on_overload: str = "abort",
    progress: Progress | None = None,
) -> "SoakReport":
    """Play a stream of 100 kHz in real time through the acquisition (`rig bench --soak`).

    window: windows that move with the line, instead of whole frames. slow_consumer_s: added to every map. on_overload:
    as of `scan`; a stream that it ends is a report too. progress: called with frames done and planned.
    """
    from rig.bench.soak import SoakOptions
    from rig.bench.soak import soak as play
    from rig.overload import Overload

    return play(SoakOptions(seconds, window, Overload.parse(on_overload), slow_consumer_s, threads), progress)


def warm_up(config: Config = SIMULATED) -> float:
    """Compile every kernel that a scan with this config can need (`rig warmup`); the seconds it took.

    Real devices are not opened.
    """
    from rig.warm_rig import warm_rig

    return warm_rig(configure(config))
