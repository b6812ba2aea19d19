"""A whole rig with a small sensor, emulated outside of the application that scans with it, so that it outlives it.

    with closing(Applications()) as applications, scan_bench(applications, "cobolt") as bench:
        bench.start(maps=10)
        ...
        bench.light(since_s), bench.light_at_rest(since_s)

Laser and gate hang on pseudo terminals, scanner and SPAD on real libusb under umockdev: what happens to a port when a
process is killed happens here too (a Helios stops and jumps to its centre).
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from drivers.clock import SystemClock
from drivers.interfaces import OUT_GATE
from drivers.registry import Surroundings
from sim_backend.wire.emulated_world import EmulatedWorld, EmulatedWorldConfig
from sim_backend.wire.firmware.helios import BLUE
from sim_backend.wire.firmware.pulsestreamer import PulseStreamerModel
from tests.system.small_rig import calibration, emulated
from tests.wire.usb.umockdev import PRELOAD, UmockdevBus

WIDTH, HEIGHT = 64, 16
COLUMNS, EXPOSURES = 20, 12
POWER = "20 mW"
CARD_BUFFER_S = 0.5
PATIENT_BUFFER_S = 1.0
"""Buffer of an NI card where nothing is measured: the mirror goes on until a busy machine has noticed a hung server."""
STILL_S = 1e-3
"""A mirror whose drive did not change for so long rests; a galvo needs about as long to come to rest."""
STEP_S = 5e-5
FIRST_LIGHT_S = 120.0
"""A Cobolt takes ten commands a second, and may warm up."""


class ScanFailedError(Exception):
    """Raised where a scan never came to light; with all that it said."""


def light(world: EmulatedWorld, from_s: float, until_s: float) -> list[tuple[float, float]]:
    """(start, end) of every period with light (emission AND gate) in [from_s, until_s], ascending. Behind a Pulse
    Streamer, whose rig has `hold: external`, light also needs the scan marker.

    Times are the host's, at most until now; only the last `KEPT_S` are known.
    """
    with world.gate_wire.lock:
        world.sync.advance(until_s)
        gate = [(at, 0, bool(word & OUT_GATE)) for at, word in world.sync.changes(from_s, until_s)]
    with world._emission_lock:
        emission = [(max(at, from_s), 1, power_w > 0) for at, power_w in world._emission if at < until_s]
    levels, begun_s, found = [False, False, True], 0.0, []
    if isinstance(world.sync, PulseStreamerModel):
        at = np.arange(from_s, until_s, STEP_S)
        with world.scanner_plug.lock:
            world.scanner.advance(until_s)
            high = world.scanner.history.level(BLUE, at) > 0
        gate += [(float(at[index]), 2, bool(high[index])) for index in np.flatnonzero(np.diff(high, prepend=~high[:1]))]
    changes = sorted(gate + emission, key=lambda change: change[0])  # of several before `from_s` the last one holds
    for at_s, which, level in [*changes, (until_s, 0, False)]:
        was_lit = all(levels)
        levels[which] = level
        if all(levels) and not was_lit:
            begun_s = at_s
        elif was_lit and not all(levels) and at_s > begun_s:
            found.append((begun_s, at_s))
    return found


def mirror(world: EmulatedWorld, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normalised command to which the scanner's output drives the mirror at times (n,)."""
    with world.scanner_plug.lock:
        world.scanner.advance(float(time_s[-1]))
        return world.scanner.history.command(time_s)


class Applications:
    """The process that forks those that scan."""

    def __init__(self) -> None:
        environment = {**os.environ, "LD_PRELOAD": PRELOAD, "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.wire.scans.scanning_application"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )
        if self._answer() != "ready":
            raise ScanFailedError("the application's process did not start")

    def start(self, arguments: list[str], environment: dict[str, str], log: Path, labours: bool) -> int:
        """`rig` with these arguments; its process number."""
        return int(self._ask(arguments=arguments, environment=environment, log=str(log), labours=labours))

    def exit_code(self, number: int, within_s: float) -> Any:
        """Its exit code, negative for a signal; None: it still runs."""
        return self._ask(wait=number, within_s=within_s)

    def close(self) -> None:
        self._process.communicate()

    def _ask(self, **request: Any) -> Any:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        return json.loads(line) if line else None


@dataclass
class ScanBench:
    """The emulated devices, and at most one scan with them."""

    world: EmulatedWorld
    folder: Path
    bus_environment: dict[str, str]
    applications: Applications
    card_buffer_s: float
    number: int = 0
    started_s: float = 0.0

    def start(self, *, maps: int, record: bool = False, labours: bool = False) -> None:
        """Begin a scan of so many maps. labours: with a disk that stalls and little of the interpreter."""
        out = ["--out", str(self.folder / "run"), "--save", "last", *(["--record"] if record else [])]
        arguments = ["scan", str(self.folder / "rig.yaml"), "--arm", "--maps", str(maps), *out]
        (self.folder / "log").touch()
        self.started_s = time.monotonic()
        self.number = self.applications.start(arguments, self.bus_environment, self.folder / "log", labours)

    @property
    def said(self) -> str:
        """All that the application wrote to the terminal."""
        return (self.folder / "log").read_text(errors="replace")

    def await_light(self) -> None:
        """Return at the first light."""
        ends_at = time.monotonic() + FIRST_LIGHT_S
        while not self.light(self.started_s):
            code = self.applications.exit_code(self.number, 0.001)
            if code is not None or time.monotonic() > ends_at:
                if code is None:
                    os.kill(self.number, signal.SIGUSR1)  # it says where it hangs
                    time.sleep(0.5)
                raise ScanFailedError(f"no light, code {code}:\n{self.said}")
            time.sleep(0.005)

    def guard(self) -> int:
        """Process number of the application's guard."""
        for task in Path(f"/proc/{self.number}/task").iterdir():
            for child in (task / "children").read_text().split():
                if b"drivers.guard" in Path(f"/proc/{child}/cmdline").read_bytes():
                    return int(child)
        raise ScanFailedError(f"there is no guard:\n{self.said}")

    def light(self, since_s: float) -> list[tuple[float, float]]:
        """Times of light from then to now."""
        return light(self.world, since_s, time.monotonic())

    def light_at_rest(self, since_s: float) -> list[float]:
        """Times of light on a mirror at rest from then to now, `STEP_S` each."""
        found: list[float] = []
        for begun_s, ended_s in self.light(since_s):
            at = np.arange(begun_s, ended_s, STEP_S)
            if len(at):
                drive = mirror(self.world, (at[:, None] - np.linspace(0, STILL_S, 5)).ravel()).reshape(len(at), -1)
                found += at[np.ptp(drive, axis=1) == 0].tolist()
        return found

    def dark_s(self, since_s: float) -> float:
        """Seconds from then to the end of emission, through an open gate or not; inf: it goes on."""
        changed_s, power_w = self.world._emission[-1]
        return float("inf") if power_w else max(changed_s - since_s, 0.0)


PATIENT = "1.5 s"
"""Silence of an emulated device that the guard lets pass where nothing is measured."""


@contextmanager
def scan_bench(
    applications: Applications,
    laser: str,
    silence: str = PATIENT,
    scanner: str = "helios",
    sync: str = "prawndo",
    laser_silence: str | None = PATIENT,
) -> Iterator[ScanBench]:
    """silence, laser_silence: of SPAD and laser, that the guard lets pass. A Pulse Streamer gets that of the laser.
    None: that of the device's kind."""
    with tempfile.TemporaryDirectory() as name, UmockdevBus(SystemClock()) as bus:
        folder = Path(name)
        geometry = folder / "calibration.yaml"
        geometry.write_text(yaml.safe_dump(calibration(WIDTH, HEIGHT)))
        settings = EmulatedWorldConfig.model_validate(
            {
                "kind": "emulated",
                "geometry": str(geometry),
                "scene": "street-clear",
                "laser": laser,
                "ttl_power": POWER,
                "scanner": scanner,
                "sync": sync,
                "command_grid": {"first": -0.8, "last": 0.8, "columns": COLUMNS},
            }
        )
        with closing(EmulatedWorld(settings, Surroundings(SystemClock(), None, 1), bus)) as world:
            if laser == "cobolt":
                world.laser.warm_up_s = 0.2
            elif laser == "obis":
                world.laser.cdrh_delay_s = 0.2
            ports = {name: endpoint.address for name, endpoint in world.ports.items()}
            buffer_s = CARD_BUFFER_S if laser_silence is None else PATIENT_BUFFER_S
            (folder / "rig.yaml").write_text(
                yaml.safe_dump(_config(laser, ports, silence, scanner, sync, laser_silence, buffer_s))
            )
            places = {"UMOCKDEV_DIR": bus.environment()["UMOCKDEV_DIR"]}
            bench = ScanBench(world, folder, places, applications, buffer_s)
            try:
                yield bench
            finally:
                _end(bench)


def _end(bench: ScanBench) -> None:
    """No client may outlive the bus."""
    if not bench.number:
        return
    try:
        guard = bench.guard()
    except (ScanFailedError, OSError):
        guard = 0
    for number in filter(None, (guard, bench.number)):
        with suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)
    bench.applications.exit_code(bench.number, 5.0)


def _config(
    laser: str, ports: dict[str, str], silence: str, scanner: str, sync: str, laser_silence: str | None, buffer_s: float
) -> dict[str, Any]:
    """The config of a rig with real ports; its world is outside of it."""
    content = emulated(**ports)
    del content["world"]
    content["calibration"] = "calibration.yaml"
    # The emulated bus draws frames while a transfer is queued: 64 of them would take half a second.
    content["spad"]["silence"] = silence
    # A machine that has much else to do may be late.
    content["scanner"] |= {"max_point_rate": "8 kHz", "frame": "250 ms"}
    if scanner == "etherdream":
        del content["scanner"]["frame"]
        content["scanner"] |= {"kind": scanner, "buffer": "220 ms"}
    if scanner == "nidaq":
        del content["scanner"]["frame"]
        card = {"kind": scanner, "port": f"grpc={ports['scanner']}", "buffer": f"{buffer_s} s"}
        content["scanner"] |= card
    content["laser"]["kind"], content["sync"]["kind"] = laser, sync
    if sync == "pulsestreamer":
        content["sync"] |= {"hold": "external"} | ({"silence": laser_silence} if laser_silence else {})
    if laser_silence is not None:
        content["laser"]["silence"] = laser_silence
    if laser == "ttl":
        content["laser"] = {"kind": laser, "power": POWER, "max_power": "50 mW"}  # a real one has no port
    content["scan"] |= {"columns": COLUMNS, "exposures": EXPOSURES, "frame_rate": "12.5 kHz", "power": POWER}
    content["estimate"]["threads"] = 1
    return content
