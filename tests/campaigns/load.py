"""What grows while the program works for long: memory, file handles, threads, fill of the ring, lateness of maps.

    python -m tests.campaigns.load stream --seconds 180 --rate "100 kHz" --config small
    python -m tests.campaigns.load maps --seconds 600
    python -m tests.campaigns.load scans --seconds 600

`stream` plays frames in real time into the acquisition of a scan (as `rig bench --soak` does), records all of them and
has ten viewers, processes that read the live slot ten times a second. `maps` makes as many maps of one scan of the
simulated rig as fit into the time, in virtual time, without a pause; `scans` makes as many short scans, one after the
other in one process, each recorded and estimated.

Every figure is sampled, and a line is fitted to its samples after the first fifth, in which everything is loaded and
touched. The samples are averaged in twenty parts of the time, whose scatter gives the slope's standard error. A figure
is flat where its slope is less than twice that error, or so small that it grows by less than its limit in a night of
ten hours.
"""

import argparse
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import numpy as np

from rig import api
from rig.bench import soak
from rig.bench.soak import looped_rig, quiet_sweeps
from rig.config.models import EstimateConfig
from rig.depth.reconstruct import map_geometry
from rig.depth.warm_up import warm_up
from rig.devices.prepare import prepare
from rig.live.feed import Feed
from rig.recording.writer import Recording
from rig.requests import SoakRequest
from rig.scan.acquisition import Acquisition, AcquisitionRequest
from rig.scan.monitor import NOBODY, RunBegun
from rig.scan.pipeline import Overload
from rig.scan.scan import make_reconstructor
from tests.benchmarks.viewers import readers
from tests.reference.tables.printed import Table

NIGHT_S: Final = 36_000.0
SETTLED: Final = 0.2
PARTS: Final = 20
NEVER_S: Final = 1e9
LIMITS: Final = {
    "memory, MB": 100.0,
    "file handles": 1.0,
    "threads": 1.0,
    "blocks of Python's memory": 1e5,
    "ring, share": 0.05,
    "map late, ms": 20.0,
    "time of a map, ms": 20.0,
    "time of a scan, ms": 100.0,
}
"""Growth in a night that is still called flat."""


@dataclass
class Samples:
    """Figures over time. begun_s: by `time.monotonic`. at_s: of the samples of each figure since then."""

    begun_s: float = field(default_factory=time.monotonic)
    at_s: dict[str, list[float]] = field(default_factory=dict)
    values: dict[str, list[float]] = field(default_factory=dict)

    def add(self, **figures: float) -> None:
        """One sample of each of these figures, by their names with underscores for what is not a letter."""
        self.put(figures)

    def put(self, figures: dict[str, float]) -> None:
        """One sample of each of these figures."""
        for name, value in figures.items():
            self.at_s.setdefault(name, []).append(time.monotonic() - self.begun_s)
            self.values.setdefault(name, []).append(value)

    def process(self) -> None:
        """Sample memory, handles, threads and objects of this process."""
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        self.put(
            {
                "memory, MB": pages * os.sysconf("SC_PAGE_SIZE") / 1e6,
                "file handles": len(os.listdir("/proc/self/fd")),
                "threads": threading.active_count(),
                "blocks of Python's memory": sys.getallocatedblocks(),
            }
        )


@dataclass(frozen=True)
class Slope:
    """A fitted growth. mean: of the settled samples; in_a_night: growth in ten hours; sd: its standard error."""

    mean: float
    least: float
    most: float
    in_a_night: float
    sd: float

    def flat(self, limit: float) -> bool:
        """Whether it does not grow, or by less than the limit."""
        return self.in_a_night < max(limit, 2 * self.sd)


def slope_of(at_s: Sequence[float], values: Sequence[float]) -> Slope:
    """The growth of samples at least over the last four fifths of their time, in `PARTS` means."""
    at, value = np.array(at_s), np.array(values, float)
    inside = at >= at[0] + SETTLED * (at[-1] - at[0])
    at, value = at[inside], value[inside]
    parts = [each for each in np.array_split(np.arange(len(at)), PARTS) if len(each)]
    x, y = (np.array([of[each].mean() for each in parts]) for of in (at, value))
    moved = x - x.mean()
    spread = float((moved**2).sum())
    rate = float((moved * y).sum() / spread) if spread else 0.0
    left = y - y.mean() - rate * moved
    sd = float(np.sqrt((left**2).sum() / max(1, len(x) - 2) / spread)) if spread else 0.0
    return Slope(float(value.mean()), float(value.min()), float(value.max()), rate * NIGHT_S, sd * NIGHT_S)


def stream(seconds: float, rate: str, config: str, estimator: str, exposures: int, folder: Path) -> tuple[Samples, str]:
    """Play a stream, record it, and let ten viewers watch; the samples, and what was lost."""
    samples = Samples()
    with ExitStack() as stack:
        os.environ["XDG_RUNTIME_DIR"] = str(folder)
        stack.enter_context(patch.object(soak, "CONFIG", config))
        stack.enter_context(quiet_sweeps())
        asked = SoakRequest(estimator=estimator, exposures=exposures)
        rig, spad = stack.enter_context(looped_rig(Overload.DROP, asked, {"scan.frame_rate": rate}))
        plan, timing = prepare(rig)
        warm_up(estimator, "none", plan.exposures, dark=True)
        maker = make_reconstructor(rig, plan, EstimateConfig.model_validate({"estimator": estimator}))
        maps = 2 + round(seconds / float(plan.sweep_s))
        watch = stack.enter_context(readers(folder))
        feed = Feed("scan", "load")
        listeners = feed.listeners(NOBODY)
        bytes_ = seconds * float(plan.frame_rate_hz) * plan.frame_bytes
        free = os.statvfs(folder)
        if bytes_ > 0.8 * free.f_bavail * free.f_frsize:
            raise SystemExit(f"the recording takes {bytes_ / 1e9:.0f} GB, more than there is; ask for less")
        recording = stack.enter_context(closing(Recording(folder, expected_bytes=int(bytes_))))
        ring_used = [0.0]

        def live(now: Any) -> None:
            ring_used[0] = now.ring_used

        listeners = feed.listeners(NOBODY.__class__(live=live))
        request = AcquisitionRequest(
            maps=maps, policy=Overload.DROP, first_alone=True, learns=True, listeners=listeners, recording=recording
        )
        acquisition = Acquisition(rig, plan, timing, maker, request)
        frame_s, next_s = 1 / float(plan.frame_rate_hz), 0.0
        stack.enter_context(feed)
        geometry = map_geometry(rig.model, plan.commands, plan.depth_range_m)
        feed.begin(RunBegun(rig, plan, geometry, maps, None))
        watch(True)
        for found in stack.enter_context(closing(acquisition.run())):
            if listeners.maps is not None:
                listeners.maps(found)
            now_s = time.perf_counter()
            if found.sweep.index == 0:
                samples.begun_s = time.monotonic()
                continue
            late_s = now_s - spad.started_s - found.sweep.end_frame * frame_s
            samples.put({"map late, ms": 1e3 * late_s})
            if time.monotonic() - samples.begun_s > seconds:  # where frames are lost, maps are made of later ones
                break
            if now_s >= next_s:
                next_s = now_s + 0.5
                samples.process()
                samples.put({"ring, slots used": ring_used[0]})
        counters, stages = acquisition.counters, acquisition.stages
        watch(False)
        size = f"{plan.rows} x {plan.frame_width} px"
        told = (
            f"{counters.exposed} frames of {size} at {rate}, {estimator}, K = {plan.exposures}: {counters.lost} lost, "
            f"{recording.blocks} blocks and {recording.bytes / 1e9:.1f} GB recorded, ring at most "
            f"{stages.ring_high_water} slots, {stages.monitor_updates} looks of the monitor"
        )
    return samples, told


def maps(seconds: float, config: str, estimator: str) -> tuple[Samples, str]:
    """One scan in virtual time with as many maps as fit."""
    samples, ends_s, made = Samples(), time.monotonic() + seconds, [0]
    last_s = [time.monotonic()]

    class EnoughError(Exception):
        """Raised when the time is over."""

    def live(now: Any) -> None:
        if time.monotonic() - last_s[0] > 0.5:
            if now.sweeps > made[0]:
                samples.put({"time of a map, ms": 1e3 * (time.monotonic() - last_s[0]) / (now.sweeps - made[0])})
            last_s[0], made[0] = time.monotonic(), now.sweeps
            samples.process()
        if time.monotonic() > ends_s:
            raise KeyboardInterrupt

    with tempfile.TemporaryDirectory(prefix="spadrig-load-") as folder:
        result = api.scan(
            config, maps=10_000_000, save="last", out=Path(folder) / "run", estimator=estimator, live=live
        )
    return samples, f"{result.summary.maps} maps of {config} with {estimator}, {result.summary.frames.lost} frames lost"


def scans(seconds: float, config: str, estimator: str) -> tuple[Samples, str]:
    """As many short scans as fit, each recorded, read and estimated again."""
    samples, ends_s, done = Samples(), time.monotonic() + seconds, 0
    while time.monotonic() < ends_s:
        begun_s = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="spadrig-load-") as folder:
            run = Path(folder) / "run"
            api.scan(config, maps=2, out=run, record=True, estimator=estimator, seed=done % 100)
            api.reconstruct(run, out=Path(folder) / "again")
        done += 1
        samples.put({"time of a scan, ms": 1e3 * (time.monotonic() - begun_s)})
        samples.process()
    return samples, f"{done} scans of {config} with {estimator}, recorded and reconstructed"


def main(arguments: Sequence[str] | None = None) -> int:
    """Work for so long, print how each figure grew, and return 1 if one is not flat."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=["stream", "maps", "scans"])
    parser.add_argument("--seconds", type=float, default=180.0)
    parser.add_argument("--rate", default="100 kHz", help="frames a second of the stream")
    parser.add_argument("--config", default="small", help="bundled rig, 'simulated' for 512 x 512 px")
    parser.add_argument("--estimator", default="likelihood")
    parser.add_argument("--exposures", type=int, default=10, help="of the stream")
    parser.add_argument("--folder", type=Path, help="on the disk that the stream is recorded on")
    given = parser.parse_args(arguments)
    if given.kind == "stream":
        with tempfile.TemporaryDirectory(prefix="spadrig-load-", dir=given.folder) as folder:
            samples, told = stream(
                given.seconds, given.rate, given.config, given.estimator, given.exposures, Path(folder)
            )
    else:
        work: Callable[[float, str, str], tuple[Samples, str]] = maps if given.kind == "maps" else scans
        samples, told = work(given.seconds, given.config, given.estimator)
    print(told)
    return tell(samples)


def tell(samples: Samples) -> int:
    """Print the table; 1 if a figure is not flat."""
    table = Table(("figure", "samples", "mean", "least", "most", "growth in 10 h", "standard error", ""))
    growing = 0
    for name, values in samples.values.items():
        slope = slope_of(samples.at_s[name], values)
        flat = slope.flat(LIMITS.get(name, 1.0))
        growing += not flat
        cells = (f"{each:.4g}" for each in (slope.mean, slope.least, slope.most, slope.in_a_night, slope.sd))
        table.add((name, len(values), *cells, "flat" if flat else "grows"))
    return 1 if growing else 0


if __name__ == "__main__":
    sys.exit(main())
