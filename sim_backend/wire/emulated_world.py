"""The simulated world behind emulated devices: real drivers on emulated wires, one scene in front of them.

    rig -> real driver -> pyusb, pyserial -> emulated bus, pseudo terminal -> device model
                                                                                |
    light = laser's emission AND sync source's gate; mirror = scanner's output; frames = SPAD's exposures

Everything runs in the host's time. Frames are drawn when the host takes them, of what the rig did while they were
exposed; the SPAD's memory has room for a simulation that takes longer than that.
"""

import os
import threading
from bisect import bisect_right
from collections.abc import Mapping
from types import TracebackType
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.registry import Kind, Surroundings
from drivers.transports.endpoints import Endpoint
from sim_backend.bench import Happening
from sim_backend.devices.markers import MarkerInputs, windows_at
from sim_backend.gate_program import gate_shares
from sim_backend.photons import PhotonSource
from sim_backend.wire.cobolt import CoboltModel
from sim_backend.wire.helios import BLUE, GREEN, INTENSITY, HeliosModel
from sim_backend.wire.obis import ObisModel
from sim_backend.wire.prawndo import PrawnDoModel
from sim_backend.wire.serial_server import SerialServer
from sim_backend.wire.spb_usb import Span, SpbUsbModel
from sim_backend.wire.usb_backend import EmulatedUsb
from sim_backend.world import SimulatedWorld, WorldConfig

Array = NDArray[np.float64]

MAX_THREADS = 8
USB_BAUD = 10_000_000
"""A virtual COM port is as fast as USB lets it be."""
PICO_2 = 2
KEPT_FRAMES = 1_000_000_000
"""Frames that wait for the host: as many as there may be."""


class EmulatedWorldConfig(WorldConfig):
    """Config of the world with emulated devices; `port: emulated:laser`, `gate`, `scanner`, `spad` mean them."""

    real_time: ClassVar[bool] = True

    kind: str = "emulated"
    laser: Literal["cobolt", "obis"] = "cobolt"
    """Which laser answers at emulated:laser."""
    scanner_clock_error: float = Field(default=20e-6, ge=-1e-3, le=1e-3)
    """By how much the scanner's crystal runs fast."""


class EmulatedWorld(SimulatedWorld):
    """One scene and the devices that look at it, plugged in from its creation to `close`."""

    def __init__(self, config: EmulatedWorldConfig, surroundings: Surroundings) -> None:
        """DeviceError where the geometry or the scene cannot be used."""
        super().__init__(config, surroundings)
        rows, width = self.size
        clock, self._seed = surroundings.clock, surroundings.seed
        self._emission_lock = threading.Lock()
        self._emission: list[tuple[float, float]] = [(-np.inf, 0.0)]
        self.laser = (CoboltModel if config.laser == "cobolt" else ObisModel)(on_emission=self._note_emission)
        self.sync = PrawnDoModel(self._scan_marker, board=PICO_2)
        self.scanner = HeliosModel(clock_error=config.scanner_clock_error)
        self.spad = SpbUsbModel(WorldFrames(self), width, rows, paced=True, fifo_frames=KEPT_FRAMES)
        self._bus = EmulatedUsb(clock)
        self._scanner_plug = self._bus.plug(self.scanner)
        self._bus.plug(self.spad)
        self._laser_wire = SerialServer(self.laser, clock=clock).start()
        self._gate_wire = SerialServer(self.sync, clock=clock, baud=USB_BAUD).start()
        on_bus = Endpoint("usb", emulated=True, usb_backend=self._bus)
        self.ports: Mapping[str, Endpoint] = {
            "laser": self._laser_wire.endpoint,
            "gate": self._gate_wire.endpoint,
            "scanner": on_bus,
            "spad": on_bus,
        }
        """Where the emulated devices are."""

    def close(self) -> None:
        """Unplug everything; again: nothing happens."""
        self._laser_wire.close()
        self._gate_wire.close()

    def __enter__(self) -> Self:
        """The world itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()

    @property
    def seed(self) -> int:
        """Of all that is random here."""
        return self._seed

    def photon_source(self, exposure_s: float) -> PhotonSource:
        """What draws frames of that exposure."""
        threads = min(MAX_THREADS, os.cpu_count() or 1)
        return PhotonSource(self.flux_model, self.model.planes, exposure_s, self._seed, threads)

    def during(self, start_s: Array, exposure_s: float, period_s: float) -> tuple[Happening, Array]:
        """What happened during frames that start at start_s (n,), ascending, one period apart, and the laser's power.

        Times are the host's; power_w (n,) of each exposure's middle.
        """
        middle, until_s = start_s + 0.5 * exposure_s, float(start_s[-1]) + period_s
        history, lag = self.scanner.history, self.model.lag_s
        with self._scanner_plug.lock:
            backward = history.level(INTENSITY, start_s) > 0
            lag_s = np.where(history.level(INTENSITY, middle) > 0, lag.backward, lag.forward)
            mirror = history.command(middle - lag_s)
            line_s = history.rising(GREEN, float(start_s[0]), until_s)
            scan_s = history.rising(BLUE, float(start_s[0]), until_s)
        with self._gate_wire.lock:
            self.sync.advance(until_s)
            changes = self.sync.changes(float(start_s[0]), until_s)
        times, words = np.array([t for t, _ in changes]), np.array([word for _, word in changes], np.int64)
        share, edge = gate_shares(times, words, start_s, exposure_s)
        power_w = self._power(middle)
        return Happening(mirror, share, edge, backward, line_s, scan_s, float(power_w[0])), power_w

    def _power(self, time_s: Array) -> Array:
        with self._emission_lock:
            at = [bisect_right(self._emission, (float(t), np.inf)) - 1 for t in time_s[[0, -1]]]
            if at[0] == at[1]:
                return np.full(len(time_s), self._emission[at[0]][1])
            times, power = (np.array(column) for column in zip(*self._emission, strict=True))
        found: Array = power[np.searchsorted(times, time_s, side="right") - 1]
        return found

    def _note_emission(self, emits: bool, now_s: float) -> None:
        with self._emission_lock:
            self._emission.append((now_s, self.laser.power_w if emits else 0.0))

    def _scan_marker(self, from_s: float, until_s: float) -> float | None:
        """The sync source's trigger input hangs on the scanner's scan marker."""
        with self._scanner_plug.lock:
            if self.scanner.history.level(BLUE, np.array([from_s]))[0]:
                return from_s
            edges = self.scanner.history.rising(BLUE, from_s, until_s)
        return float(edges[0]) if len(edges) else None


class WorldFrames:
    """What the emulated SPAD sees: a `FrameSource`."""

    def __init__(self, world: EmulatedWorld) -> None:
        self._world = world
        self._markers = MarkerInputs()
        self._photons: PhotonSource | None = None
        self._exposure_s = 0.0

    def started(self) -> None:
        """A run begins: counters of markers are 0."""
        self._markers = MarkerInputs()

    def expose(self, span: Span, records: NDArray[np.void], bits: NDArray[np.uint8] | None) -> int:
        """See `FrameSource`."""
        start_s: Array = span.start_s + np.arange(span.n, dtype=np.float64) * span.period_s
        happening, power_w = self._world.during(start_s, span.exposure_s, span.period_s)
        sweep = self._markers.record(happening, start_s, span.period_s, records)
        x0 = windows_at(span.window, sweep, records)
        records["x0"] = x0
        if bits is not None:
            held = self._world.grid.hold(happening.mirror)
            self._source(span.exposure_s).expose(span.first_frame, held, power_w * happening.share, x0, bits)
        return sweep

    def _source(self, exposure_s: float) -> PhotonSource:
        if self._photons is None or exposure_s != self._exposure_s:
            if self._photons is not None:
                self._photons.close()
            self._photons, self._exposure_s = self._world.photon_source(exposure_s), exposure_s
        return self._photons


KIND = Kind(config=EmulatedWorldConfig, create=EmulatedWorld)
