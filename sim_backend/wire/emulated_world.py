"""The simulated world behind emulated devices: real drivers on emulated wires, with one scene in front of them.

    rig -> real driver -> pyusb, pyserial, socket -> emulated bus, pseudo terminal, port -> device model
                                                                                              |
    light = laser's emission AND sync source's gate; mirror = scanner's output; frames = SPAD's exposures

Everything runs in the host's time. Frames are drawn when the host takes them, from what the rig did while they were
exposed. If the simulation takes longer than the exposures, frames wait in the SPAD's memory.
"""

import threading
from contextlib import closing
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from drivers.clock import Clock, now_s
from drivers.cores import cores
from drivers.errors import DeviceError
from drivers.frames import FRAME_RECORD, packed_row_bytes
from drivers.lasers.ttl import BY_HAND
from drivers.registry import Kind, Surroundings
from drivers.transports.endpoints import Endpoint
from drivers.units import Watts
from sim_backend.bench import BenchState
from sim_backend.devices.spad import MarkerInputs, windows_at
from sim_backend.effects.setting import FrameTimes
from sim_backend.frames.flux import FluxModel
from sim_backend.frames.photons import PhotonSource
from sim_backend.gate_program import gate_shares
from sim_backend.wire.firmware.cobolt import CoboltModel
from sim_backend.wire.firmware.etherdream import EtherDreamModel
from sim_backend.wire.firmware.helios import BLUE, GREEN, INTENSITY, HeliosModel
from sim_backend.wire.firmware.ibeam import IbeamModel
from sim_backend.wire.firmware.nidaq import NidaqModel
from sim_backend.wire.firmware.obis import ObisModel
from sim_backend.wire.firmware.prawndo import PrawnDoModel
from sim_backend.wire.firmware.pulsestreamer import PulseStreamerModel
from sim_backend.wire.firmware.spad512s import Spad512sModel
from sim_backend.wire.firmware.spb_usb import SpbUsbModel
from sim_backend.wire.firmware.spb_usb_run import Span, SpbUsbBoard
from sim_backend.wire.firmware.teensy import TeensyModel
from sim_backend.wire.serve.grpc import GrpcServer
from sim_backend.wire.serve.http import HttpServer
from sim_backend.wire.serve.serial import SerialServer
from sim_backend.wire.serve.tcp import TcpServer
from sim_backend.wire.serve.usb import EmulatedUsb
from sim_backend.wire.serve.usb_model import AttachedDevice
from sim_backend.wire.serve.wire_server import WireServer
from sim_backend.world import SimulatedWorld, WorldConfig

Array = NDArray[np.float64]

MAX_THREADS = 8
USB_BAUD = 10_000_000
"""Baud of a virtual COM port, which is as fast as USB lets it be."""
PICO_2 = 2
KEPT_S = 20.0
"""Age at which the gate's history is dropped."""
KEPT_FRAMES = 1_000_000_000
"""Most frames that wait for the host."""


LASERS = {"cobolt": CoboltModel, "ibeam": IbeamModel, "obis": ObisModel}
"""Firmware models that can answer at emulated:laser. Each needs `on_emission`, `power_w` and `receive`."""
LOOK_S = 10e-6
"""Step of the times at which the scan marker is looked at. Even at the highest point rates it is low for longer."""


class EmulatedWorldConfig(WorldConfig):
    """Config of the world with emulated devices. Their ports are `emulated:laser`, `emulated:gate`, `emulated:scanner`
    and `emulated:spad`."""

    real_time: ClassVar[bool] = True

    kind: str = "emulated"
    laser: Literal["cobolt", "ibeam", "obis", "ttl"] = "cobolt"
    """The laser that answers at emulated:laser. `ttl` does not answer; it shines whenever the gate is high."""
    ttl_power: Annotated[Watts, Field(gt=0)] = 0.05
    """Power to which a laser of kind `ttl` was set by hand; `laser.power` must be the same."""
    scanner: Literal["helios", "etherdream", "nidaq"] = "helios"
    """The scanner that answers at emulated:scanner."""
    sync: Literal["prawndo", "pulsestreamer", "teensy"] = "prawndo"
    """The sync source that answers at emulated:gate."""
    spad: Literal["spb-usb", "spad512s"] = "spb-usb"
    """The SPAD that answers at emulated:spad."""
    scanner_clock_error: float = Field(default=20e-6, ge=-1e-3, le=1e-3)
    """Relative amount by which the scanner's crystal runs fast."""


class EmulatedWorld(SimulatedWorld):
    """One scene and the emulated devices of a rig in front of it. They are plugged in when the world is created."""

    def __init__(self, config: EmulatedWorldConfig, surroundings: Surroundings, bus: Any = None) -> None:
        """Raises DeviceError as `SimulatedWorld` does, for a geometry with a row delay, and for `nidaq` if the packages
        that it needs are not installed.

        bus: an object with a method `plug` that attaches a USB device; the caller closes it. By default an
        `EmulatedUsb`, within this process.
        """
        super().__init__(config, surroundings)
        if self.model.row_delay_s != 0:
            raise DeviceError(
                f"world geometry {config.geometry} has a row_delay_s of {self.model.row_delay_s:g}; behind emulated "
                "devices all rows are exposed at once: leave it out, or use simulated devices"
            )
        rows, width = self.size
        clock, self._seed = surroundings.clock, surroundings.seed
        self._emission_lock = threading.Lock()
        self._emission: list[tuple[float, float]] = [(-np.inf, 0.0)]
        """(time, power) of every change of the power in W behind an open gate."""
        self._draw_once()
        self._frames = WorldFrames(self, clock)
        self._wires: list[WireServer[Any]] = []
        bus = bus or EmulatedUsb(clock)
        on_bus = Endpoint("usb", usb_backend=bus if isinstance(bus, EmulatedUsb) else None)
        self.spad = SpbUsbModel(self._frames, SpbUsbBoard(width, rows, paced=True, fifo_frames=KEPT_FRAMES))
        self.spad_plug = bus.plug(self.spad)
        self.ports: dict[str, Endpoint] = {"scanner": on_bus, "spad": on_bus}
        try:
            if config.spad == "spad512s":
                program = self._start(TcpServer(Spad512sModel(self._frames.whole, paced=True), clock=clock))
                self.ports["spad"] = program.endpoint
            self.scanner: Any
            self.scanner_plug: AttachedDevice | WireServer[Any]
            if config.scanner == "helios":
                self.scanner = HeliosModel(clock_error=config.scanner_clock_error)
                self.scanner_plug = bus.plug(self.scanner)
            else:
                if config.scanner == "nidaq":
                    self.scanner = NidaqModel(clock_error=config.scanner_clock_error)
                    server: WireServer[Any] = GrpcServer(self.scanner, clock=clock)
                else:
                    self.scanner = EtherDreamModel(clock_error=config.scanner_clock_error)
                    server = TcpServer(self.scanner, clock=clock)
                self.scanner_plug = self._start(server)
                within = "/Dev1" if config.scanner == "nidaq" else ""
                self.ports["scanner"] = Endpoint(server.endpoint.address + within)
            self.sync: Any
            if config.sync == "pulsestreamer":
                self.sync = PulseStreamerModel(self._scan_marker, low=self._marker_low)
                self.gate_wire = self._start(HttpServer(self.sync, clock=clock))
            else:
                self.sync = (
                    TeensyModel(self._scan_marker, self._marker_low)
                    if config.sync == "teensy"
                    else PrawnDoModel(self._scan_marker, board=PICO_2)
                )
                self.gate_wire = self._start(SerialServer(self.sync, clock=clock, baud=USB_BAUD))
            self.ports["gate"] = self.gate_wire.endpoint
            self.laser: Any = None
            if config.laser == "ttl":
                self._emission = [(-np.inf, config.ttl_power)]
                self.ports["laser"] = Endpoint(f"{BY_HAND}{config.ttl_power}")
            else:
                self.laser = LASERS[config.laser](on_emission=self._note_emission)
                self.laser_wire = self._start(SerialServer(self.laser, clock=clock))
                self.ports["laser"] = self.laser_wire.endpoint
        except BaseException:
            self.close()
            raise

    def _start(self, server: WireServer[Any]) -> WireServer[Any]:
        self._wires.append(server.start())
        return server

    def close(self) -> None:
        """Unplug all but the USB devices and end the threads; a second call does nothing."""
        for wire in self._wires:
            wire.close()
        self._frames.close()

    def photon_source(self, times: FrameTimes) -> PhotonSource:
        """A source of frames with this timing; the caller closes it."""
        return self.photons(times, self._seed, min(MAX_THREADS, cores()))

    def _draw_once(self) -> None:
        """Draw a lit frame before time counts: once the laser is armed, nothing may be left to plan or to compile."""
        rows, width = self.size
        bits = np.zeros((1, rows, packed_row_bytes(width)), np.uint8)
        held, power_w, x0 = np.array([np.mean(self.model.scanner.command_range)]), np.ones(1), np.zeros(1, np.int32)
        with closing(self.photon_source(FrameTimes(1e-5, 1e-5))) as source:
            source.expose(0, held, power_w, x0, bits, np.zeros(1))

    def during(self, start_s: Array, exposure_s: float, period_s: float) -> tuple[BenchState, Array]:
        """State of the rig during frames that start at start_s (n,), ascending, one period apart, and the laser power
        in W (n,) that an open gate lets out in the middle of each exposure.

        Times are the host's. The state's own power_w is that of the first frame, and its velocity is unknown (NaN).
        """
        middle, until_s = start_s + 0.5 * exposure_s, float(start_s[-1]) + period_s
        history, lag = self.scanner.history, self.model.lag_s
        with self.scanner_plug.lock:
            self.scanner.advance(until_s)
            backward = history.level(INTENSITY, start_s) > 0
            lag_s = np.where(history.level(INTENSITY, middle) > 0, lag.backward, lag.forward)
            mirror = history.command(middle - lag_s)
            line_s = history.rising(GREEN, float(start_s[0]), until_s)
            scan_s = history.rising(BLUE, float(start_s[0]), until_s)
        with self.gate_wire.lock:
            self.sync.advance(until_s)
            self.sync.forget(float(start_s[0]) - KEPT_S)
            changes = self.sync.changes(float(start_s[0]), until_s)
        times, words = np.array([t for t, _ in changes]), np.array([word for _, word in changes], np.int64)
        share, edge = gate_shares(times, words, start_s, exposure_s)
        power_w = self._power(middle)
        unknown = np.full(len(mirror), np.nan)  # the command goes in steps, which have no velocity
        return BenchState(mirror, unknown, share, edge, backward, line_s, scan_s, float(power_w[0])), power_w

    def _power(self, time_s: Array) -> Array:
        with self._emission_lock:
            times, power = np.array(self._emission).T
        found: Array = power[np.searchsorted(times, time_s, side="right") - 1]
        return found

    def _note_emission(self, emits: bool, now_s: float) -> None:
        with self._emission_lock:
            self._emission.append((now_s, self.laser.power_w if emits else 0.0))

    def _scan_marker(self, from_s: float, until_s: float) -> float | None:
        """First time in [from_s, until_s) when the scan marker is high, or None. It triggers the sync source."""
        with self.scanner_plug.lock:
            self.scanner.advance(until_s)
            if self.scanner.history.level(BLUE, np.array([from_s]))[0]:
                return from_s
            edges = self.scanner.history.rising(BLUE, from_s, until_s)
        return float(edges[0]) if len(edges) else None

    def _marker_low(self, from_s: float, until_s: float) -> float | None:
        """First time in [from_s, until_s) when the scan marker is low, or None."""
        with self.scanner_plug.lock:
            self.scanner.advance(until_s)
            level = self.scanner.history.level
            times = np.arange(from_s, until_s, LOOK_S)
            low = np.flatnonzero(level(BLUE, times) == 0)
            if not len(low) or low[0] == 0:
                return from_s if len(low) else None
            between = np.linspace(times[low[0] - 1], times[low[0]], 101)
            return float(between[np.argmin(level(BLUE, between))])


class WorldFrames:
    """Frames of the simulated world for the emulated SPAD: as a `FrameSource` for SPB1 boards, and from `whole` for the
    SPAD512S."""

    def __init__(self, world: EmulatedWorld, clock: Clock) -> None:
        self._world = world
        self._begun_s = now_s(clock)
        """Time from which a moving scene moves, as in a simulated world."""
        self._markers = MarkerInputs()
        self._photons: PhotonSource | None = None
        self._made_for: tuple[FrameTimes, FluxModel] | None = None

    def started(self) -> None:
        """Set the counters of markers to 0 at the start of a run."""
        self._markers = MarkerInputs()

    def expose(self, span: Span, records: NDArray[np.void], bits: NDArray[np.uint8] | None) -> int:
        """See `FrameSource`."""
        start_s: Array = span.start_s + np.arange(span.n, dtype=np.float64) * span.period_s
        self._world.bench.spad_start_s = span.start_s - span.first_frame * span.period_s - self._begun_s
        state, power_w = self._world.during(start_s, span.exposure_s, span.period_s)
        sweep = self._markers.record(state, start_s, span.period_s, records)
        x0 = windows_at(span.window, sweep, records)
        records["x0"] = x0
        if bits is not None:
            held = self._world.mirror_positions(state, span.period_s)
            source = self._source(FrameTimes(span.exposure_s, span.period_s))
            source.expose(span.first_frame, held, power_w * state.share, x0, bits, start_s - self._begun_s)
        return sweep

    def whole(self, first_frame: int, start_s: float, period_s: float, n: int) -> NDArray[np.uint8]:
        """n full frames as the camera sees them, uint8 (n, height, row bytes), exposed for their whole period. start_s:
        start of the first one, in the host's time. The frames' records are dropped, since the SPAD512S sends pixels
        only."""
        rows, width = self._world.size
        bits = np.zeros((n, rows, packed_row_bytes(width)), np.uint8)
        self.expose(Span(first_frame, n, start_s, period_s, period_s, None), np.zeros(n, FRAME_RECORD), bits)
        return bits

    def close(self) -> None:
        """End the drawing threads; a second call does nothing."""
        if self._photons is not None:
            self._photons.close()
            self._photons = None

    def _source(self, times: FrameTimes) -> PhotonSource:
        wanted = times, self._world.flux_model
        if self._photons is None or wanted != self._made_for:
            self.close()
            self._photons, self._made_for = self._world.photon_source(times), wanted
        return self._photons


KIND = Kind(config=EmulatedWorldConfig, create=EmulatedWorld)
