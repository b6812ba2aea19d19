"""What ten viewers cost an acquisition: python -m tests.benchmarks.viewers.

The stream of `rig bench --soak` is played in real time, turn after turn, in one run. By turns nobody watches, ten
readers of the slot watch, and there is no feed at all; the order changes from round to round. Each reader is a process
that copies all sections ten times a second and follows an image row. With --page they are ten browsers' web sockets at
one `rig view --live` instead. A map's lateness is the time from the end of its last frame, as the SPAD plays it, to its
delivery to the caller.

Other work on the machine disturbs the measurement. On Linux `setsid sh -c 'echo -20 > /proc/self/autogroup; exec
python -m tests.benchmarks.viewers'`, as root, sets the processors aside for this session, viewers included.

The exit code is 1 if a limit is broken: throughput below 0.98 of that without viewers, a frame lost, or maps later by
more than 5 ms: that of the maps of a turn that is delayed most, by the medians over the turns.
"""

import argparse
import asyncio
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterable, Callable, Iterator, Mapping
from contextlib import AsyncExitStack, ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from rig.bench.machine import machine
from rig.bench.soak import LoopedSpad, looped_rig, quiet_sweeps
from rig.cli.progress import progress
from rig.cli.tables import BENCH_WIDTH, print_machine
from rig.config.models import EstimateConfig
from rig.depth.reconstruct import map_geometry
from rig.depth.warm_up import warm_up
from rig.devices.open import OpenRig
from rig.devices.prepare import prepare
from rig.live.feed import Feed
from rig.live.slot import SlotReader
from rig.progress import tell_stage
from rig.requests import SoakRequest
from rig.scan.acquisition import Acquisition, AcquisitionRequest
from rig.scan.monitor import NOBODY, RunBegun
from rig.scan.pipeline import Overload
from rig.scan.scan import make_reconstructor

VIEWERS = 10
ARMS = ("no feed", "nobody watches", "watched")
LEAST_THROUGHPUT, MOST_LATER_S = 0.98, 0.005
_READER_NICE = 10
"""As the viewer process makes itself."""


@dataclass(slots=True)
class Turns:
    """All turns of an arm, added up. late_s: lateness of each map, turn by turn. processor_s: of this process."""

    frames: int = 0
    lost: int = 0
    seconds: float = 0.0
    processor_s: float = 0.0
    late_s: list[list[float]] = field(default_factory=list)

    @property
    def frames_per_s(self) -> float:
        """Frames received and worked off in a second of the wall's clock."""
        return self.frames / self.seconds

    def late(self, percent: float) -> float:
        """Percentile of the lateness of all maps in s."""
        return float(np.percentile(self.late_s, percent))

    def each_map(self) -> NDArray[np.float64]:
        """Median lateness of each map of a turn in s: other work on the machine disturbs a few turns."""
        return np.median(self.late_s, axis=0)


def main() -> int:
    """Measure, print the rows, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=4.0, help="of stream in each turn")
    parser.add_argument("--rate", default="50 kHz", help="frames a second")
    parser.add_argument("--estimator", default="likelihood")
    parser.add_argument("--page", action="store_true", help="ten web sockets at one rig view --live")
    parser.add_argument("--read", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--browse", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.read is not None:
        return read_for_ever(given.read)
    if given.browse is not None:
        return asyncio.run(browse_for_ever(given.browse))
    with progress(), tempfile.TemporaryDirectory(prefix="spadrig-viewers-") as folder:
        os.environ["XDG_RUNTIME_DIR"] = folder
        turns = measure(given, Path(folder))
    show(turns, given)
    none, watched = turns["nobody watches"], turns["watched"]
    kept = watched.frames_per_s >= LEAST_THROUGHPUT * none.frames_per_s and later_s(watched, none) <= MOST_LATER_S
    return 0 if kept and not sum(turn.lost for turn in turns.values()) else 1


def measure(given: argparse.Namespace, folder: Path) -> Mapping[str, Turns]:
    """Play the stream by turns."""
    request = SoakRequest(estimator=given.estimator)
    turns = {arm: Turns() for arm in ARMS}
    with ExitStack() as stack:
        rig, spad = stack.enter_context(looped_rig(Overload.DROP, request, {"scan.frame_rate": given.rate}))
        stack.enter_context(quiet_sweeps())
        play_turn(rig, spad, given, None, Turns())  # everything is loaded and touched once
        watch = stack.enter_context(pages() if given.page else readers(folder))
        for number in range(given.rounds):
            for place, arm in enumerate(ARMS[number % 3 :] + ARMS[: number % 3]):
                tell_stage("measuring", 3 * number + place, 3 * given.rounds, "turns")
                feed = None if arm == "no feed" else Feed("scan", arm)
                watch(arm == "watched")
                play_turn(rig, spad, given, feed, turns[arm])
    return turns


def play_turn(rig: OpenRig, spad: LoopedSpad, given: argparse.Namespace, feed: Feed | None, turn: Turns) -> None:
    """Play the stream once and add what came to `turn`. The first map is taken alone and does not count."""
    plan, timing = prepare(rig)
    warm_up(given.estimator, "none", plan.exposures, dark=True)
    geometry = map_geometry(rig.model, plan.commands, plan.depth_range_m)
    maker = make_reconstructor(rig, plan, EstimateConfig.model_validate({"estimator": given.estimator}))
    maps = 2 + round(given.seconds / float(plan.sweep_s))
    listeners = NOBODY if feed is None else feed.listeners(NOBODY)
    asked = AcquisitionRequest(maps=maps, policy=Overload.DROP, first_alone=True, learns=True, listeners=listeners)
    acquisition = Acquisition(rig, plan, timing, maker, asked)
    frame_s = 1 / float(plan.frame_rate_hz)
    processor_s, first = 0.0, 0
    turn.late_s.append([])
    with ExitStack() as stack:
        if feed is not None:
            stack.enter_context(feed)
            feed.begin(RunBegun(rig, plan, geometry, maps, None))
        for found in stack.enter_context(closing(acquisition.run())):
            if listeners.maps is not None:
                listeners.maps(found)
            now_s = time.perf_counter()
            if found.sweep.index == 0:
                processor_s, first = time.process_time(), acquisition.counters.delivered
                continue
            turn.late_s[-1].append(now_s - spad.started_s - found.sweep.end_frame * frame_s)
        turn.seconds += now_s - spad.started_s
    turn.processor_s += time.process_time() - processor_s
    turn.frames += acquisition.counters.delivered - first
    turn.lost += acquisition.counters.lost or 0


@contextmanager
def readers(folder: Path) -> Iterator[Callable[[bool], None]]:
    """Ten processes that read the slot while the switch is on."""
    switch = folder / "on"
    command = [sys.executable, "-m", "tests.benchmarks.viewers", "--read", str(switch)]
    processes = [subprocess.Popen(command, env=os.environ) for _ in range(VIEWERS)]
    try:
        time.sleep(5)  # until they are loaded
        yield lambda on: switch.touch() if on else switch.unlink(missing_ok=True)
    finally:
        for process in processes:
            process.kill()
        for process in processes:
            process.wait()


def read_for_ever(switch: Path) -> int:
    """Copy all that is new in the newest slot ten times a second, while the switch is there."""
    os.nice(_READER_NICE)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        time.sleep(0.1)
        if not switch.exists() or (found := SlotReader.newest()) is None:
            continue
        with SlotReader.open(found.path) as reader:
            numbers: dict[str, int] = {}
            while reader.alive and switch.exists():
                reader.touch(100)
                for section in ("setup", "status", "frame", "map", "row"):
                    if (value := reader.read(section, numbers.get(section, 0))) is not None:
                        numbers[section] = value.number
                time.sleep(0.1)


@contextmanager
def pages() -> Iterator[Callable[[bool], None]]:
    """One `rig view --live` with ten pages, each of which has the two web sockets of a browser. The viewer is stopped
    while nobody is to watch."""
    view = [sys.executable, "-m", "spadrig", "view", "--live", "--port", "0"]
    with subprocess.Popen(view, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as viewer:
        assert viewer.stderr is not None
        address = next(line.split()[1] for line in viewer.stderr if line.startswith("page: "))
        browse = [sys.executable, "-m", "tests.benchmarks.viewers", "--browse", address]
        with subprocess.Popen(browse, stdout=subprocess.PIPE, text=True) as browsers:
            try:
                assert browsers.stdout is not None
                assert browsers.stdout.readline() == f"{VIEWERS} pages are open\n"
                yield lambda on: viewer.send_signal(signal.SIGCONT if on else signal.SIGSTOP)
                viewer.send_signal(signal.SIGCONT)
                browsers.terminate()
                print(f"a page got {browsers.stdout.readline().strip()} in all turns together")
            finally:
                browsers.kill()
                viewer.kill()


async def browse_for_ever(address: str) -> int:
    """Open ten pages, follow a row in each as a moving cursor does, and take all that comes, until SIGTERM."""
    import viser
    from websockets.asyncio.client import connect
    from websockets.typing import Origin, Subprotocol

    os.nice(_READER_NICE)  # browsers of other computers take nothing of this one's processors
    host = urlsplit(address).netloc
    origin, version = Origin(f"http://{host}"), Subprotocol(f"viser-v{viser.__version__}")
    got = {"messages": 0, "bytes": 0}

    async def take(socket: AsyncIterable[str | bytes]) -> None:
        async for message in socket:
            got["messages"] += 1
            got["bytes"] += len(message)

    async with AsyncExitStack() as stack:
        takers = []
        for _ in range(VIEWERS):
            open_ = partial(connect, origin=origin, max_size=None, compression=None)
            data = await stack.enter_async_context(open_(f"ws://{host}/data"))
            cloud = await stack.enter_async_context(open_(f"ws://{host}/cloud", subprotocols=[version]))
            takers += [asyncio.create_task(take(data)), asyncio.create_task(take(cloud))]
            await data.send(json.dumps({"ask": "row", "row": 100, "x": 200}))
        print(f"{VIEWERS} pages are open", flush=True)
        ended = asyncio.Event()
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ended.set)
        await ended.wait()
        each = f"{got['messages'] / VIEWERS:.0f} messages, {got['bytes'] / VIEWERS / 1e6:.0f} MB"
        print(each, flush=True)
        for taker in takers:
            taker.cancel()
    return 0


def later_s(turns: Turns, others: Turns) -> float:
    """By how much the map of a turn that is delayed most is later than with the others, in s."""
    return float((turns.each_map() - others.each_map()).max())


def show(turns: Mapping[str, Turns], given: argparse.Namespace) -> None:
    """Print the rows."""
    console = Console(highlight=False, width=BENCH_WIDTH)
    print_machine(console, machine())
    watchers = "web sockets at one page" if given.page else "readers of the slot"
    print(f"{VIEWERS} {watchers}, {given.rounds} rounds of {given.seconds:g} s at {given.rate}, {given.estimator}")
    names = ("turns", "frames/s", "lost", "maps", "late ms, median", "95 %", "most", "processor")
    table = Table(*names, box=None, pad_edge=False)
    for arm, turn in turns.items():
        late = (f"{1e3 * turn.late(percent):.1f}" for percent in (50, 95, 100))
        busy = f"{turn.processor_s / turn.seconds:.2f}"
        table.add_row(arm, f"{turn.frames_per_s:.0f}", str(turn.lost), str(np.size(turn.late_s)), *late, busy)
    console.print(table)
    none, watched = turns["nobody watches"], turns["watched"]
    print(f"throughput when watched: {watched.frames_per_s / none.frames_per_s:.4f} of that when nobody watches")
    medians = watched.each_map() - none.each_map()
    most = f"{1e3 * later_s(watched, none):+.1f} ms, the median of all {1e3 * float(np.median(medians)):+.1f} ms"
    print(f"the map of a turn that is delayed most is later by {most}")
    noise = later_s(none, turns["no feed"])
    print(f"the same between a feed that nobody watches and none: {1e3 * noise:+.1f} ms")


if __name__ == "__main__":
    sys.exit(main())
