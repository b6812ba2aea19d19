"""Examines whether a scan could run (`rig doctor`), lists attached devices, and switches the laser off.

`examine` opens everything and looks at the frames of a sweep with the gate low: what the SPAD sends, and whether the
scan marker reaches the sync source. The mirror moves as in a scan, but no light leaves: the gate is low throughout and
the laser is never armed.
"""

import os
import shutil
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from serial.tools import list_ports

from calibration.errors import digits
from drivers.errors import DeviceError
from drivers.frames import FRAME_RECORD, SUBFRAME_SHIFT, Mark
from drivers.guard import GuardLimits
from drivers.interfaces import MARKER_LINE, Pulse, SpadCounters
from drivers.ring import BlockRing
from drivers.scanners.etherdream_line import broadcasts
from drivers.scanners.helios import HELIOS
from drivers.scanners.lasercube import LASERCUBE
from drivers.scanners.nidaq_card import attached_cards
from drivers.spads.spb_usb_setup import USB_IDS
from drivers.sync.pulsestreamer_rpc import discover
from drivers.transports.usb_device import attached as attached_usb
from rig.config.models import RigConfig
from rig.devices.calibration_use import NEXT, identity_of, refusals
from rig.devices.open import OpenRig, open_light, open_rig
from rig.devices.prepare import prepare, require_memory
from rig.errors import DevicesError, RigError
from rig.plan.gate_pulses import sync_program
from rig.plan.scan_plan import MAX_CLOCK_ERROR, ScanPlan
from rig.progress import tell_stage

MOST_JITTER = 0.05
"""Largest standard deviation of the line markers, in columns, with which frames can be bound to columns."""
MOST_DARK = 0.05
"""Largest share of ones with the gate low: more is daylight or a lamp on the sensor."""
WRITE_BYTES = 64 * 2**20
LEAST_FREE_BYTES = 2**30


RING_SLOTS = 8
LOOK_S = 30.0
"""Longest examination of the frames, in seconds."""
FILL_S = 5.0
DARK_PROGRAM = (Pulse(0, None), Pulse(0, 1e-3))
"""Program of the sync source that keeps all outputs low, and ends once it has been triggered."""
_LEAST_LINES = 3


@dataclass(frozen=True, slots=True)
class LineMarkers:
    """Line markers of a sweep, compared with its plan.

    rate_hz: markers per second. jitter_columns: standard deviation of their times, in columns. clock_error: relative
    excess of the scanner's clock over nominal, in the SPAD's time."""

    rate_hz: float
    jitter_columns: float
    clock_error: float


@dataclass(frozen=True, slots=True, eq=False)
class DarkLook:
    """Frames of a sweep with the gate low, and what came with them.

    records: (n,), one for each frame. dark_share: share of pixels that fired, in the first frame of each block.
    n_bytes: bytes of all frames' pixels. seconds: time from the start of the mirror until all frames had come.
    counters: those of the SPAD, read before it was stopped. triggered: whether the sync source's program ran to its
    end.
    """

    records: NDArray[np.void]
    dark_share: float
    n_bytes: int
    seconds: float
    counters: SpadCounters
    triggered: bool

    def lines(self, plan: ScanPlan) -> LineMarkers | None:
        """The line markers after the first scan marker, at most as many as planned; None if fewer than three."""
        marks = self.records["marks"].astype(np.int64)
        scans, at = (np.flatnonzero(marks & int(mark)) for mark in (Mark.SCAN, Mark.LINE))
        planned_s = np.flatnonzero(plan.waveform.markers & MARKER_LINE) / float(plan.point_rate_hz)
        at = at[at >= scans[0]][: len(planned_s)] if len(scans) else at[:0]
        if len(at) < _LEAST_LINES:
            return None
        seen = at + ((marks[at] >> SUBFRAME_SHIFT) & 0xFF) / 256
        planned_s = planned_s[: len(seen)]
        frames_per_s, offset = np.polyfit(planned_s, seen, 1)
        off = seen - (frames_per_s * planned_s + offset)
        rate = float(plan.frame_rate_hz)
        return LineMarkers(
            rate / float(np.median(np.diff(seen))), float(np.std(off)) / plan.exposures, rate / float(frames_per_s) - 1
        )


def look(rig: OpenRig, plan: ScanPlan, stride: int) -> DarkLook:
    """Run the scanner for a sweep with the gate low, then stop SPAD, scanner and sync source. Raises DeviceError.

    stride: bytes of the SPAD's largest block.
    """
    rig.scanner.load(plan.waveform, plan.scanner_repeats(1))
    rig.sync.program(DARK_PROGRAM, 1)
    if rig.guard is not None:  # frames may come late here: nothing can shine
        rig.guard.expect(GuardLimits(2 * LOOK_S, 2 * LOOK_S, 2 * LOOK_S))
    ring = BlockRing(RING_SLOTS, stride)
    frames: int | None = None
    if plan.burst_frames is not None:
        wanted = 2 * float(plan.frames_per_sweep) + 0.3 * float(plan.frame_rate_hz)
        frames = int(min(plan.burst_frames, wanted))
    records: list[NDArray[np.void]] = []
    shares: list[float] = []
    n_bytes, scans = 0, 0
    with ring.reader("doctor") as reader, ExitStack() as at_end:
        for make_safe in (rig.spad.stop, rig.scanner.park, rig.sync.abort):  # called in reverse order
            at_end.callback(make_safe)
        rig.sync.gate_low()
        rig.spad.start(frames)
        rig.sync.run()
        rig.scanner.start()
        begun = time.monotonic()
        while scans < 2 and time.monotonic() - begun < LOOK_S and rig.spad.fill(ring, FILL_S):
            block = reader.next(0.0)
            if block is not None and block.n_frames:
                records.append(block.records.copy())
                shares.append(float(np.unpackbits(np.ascontiguousarray(block.bits[:1])).mean()))
                n_bytes += block.bits.nbytes
                scans += _count(block.records, Mark.SCAN)
        seconds, counters = time.monotonic() - begun, rig.spad.counters
        triggered = rig.sync.status.state == "stopped"
    every = np.concatenate(records) if records else np.zeros(0, FRAME_RECORD)
    return DarkLook(every, float(np.mean(shares or [0.0])), n_bytes, seconds, counters, triggered)


def _count(records: NDArray[np.void], mark: Mark) -> int:
    return int(np.count_nonzero(records["marks"] & int(mark)))


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one examination. ok: False if a scan could not run."""

    name: str
    ok: bool
    text: str


def examine(config: RigConfig, folder: Path) -> list[Finding]:
    """Open the devices and examine them, the calibration, the frames of a dark sweep and the disk. The mirror moves.

    folder: where a scan would write. Faults of config and devices are findings, not errors.
    """
    findings: list[Finding] = []
    try:
        with open_rig(config) as rig:
            findings += [*_devices(rig), _calibration(rig)]
            plan, timing = prepare(rig)
            require_memory(rig, plan)
            rig.sync.program(*sync_program(plan, len(plan.legs)))
            findings.append(_plan(plan))
            tell_stage("looking at the stream")
            findings += _frames(look(rig, plan, timing.stride), plan)
            if (fault := rig.scanner.status.fault) is not None:
                findings.append(Finding("scanner", False, f"ended on the way: {fault}"))
            if (most := rig.spad.health.memory_high_water_bytes) is not None:
                findings.append(Finding("memory", True, f"at most {digits(most / 1e6)} MB waited in the SPAD"))
    except (RigError, DeviceError) as error:
        findings += [Finding("devices", False, line) for line in str(error).splitlines()]
    tell_stage("writing to the disk")
    findings.append(_disk(folder))
    return findings


def _devices(rig: OpenRig) -> list[Finding]:
    info, scanner_fault = rig.spad.info, rig.scanner.status.fault
    said = [rig.spad.identity, f"{info.width} x {info.height} px", *_health(rig)]
    guard = "none: the laser is simulated" if rig.guard is None else f"process {rig.guard.pid} owns laser and gate"
    return [
        Finding("spad", True, ", ".join(said)),
        Finding("scanner", scanner_fault is None, f"{rig.scanner.identity}: {scanner_fault or 'ready'}"),
        Finding("sync", True, f"{rig.sync.identity}: resolution {rig.sync.resolution_s * 1e9:g} ns"),
        _laser(rig),
        Finding("guard", True, guard),
    ]


def _health(rig: OpenRig) -> list[str]:
    health = rig.spad.health
    said = [f"{place} {celsius:.1f} C" for place, celsius in health.temperatures_c.items()]
    if health.excess_bias_v is not None:
        said.append(f"excess bias {health.excess_bias_v:g} V")
    if health.frame_clock_hz is not None:
        said.append(f"frame clock {health.frame_clock_hz:.6g} Hz")
    return said


def _laser(rig: OpenRig) -> Finding:
    status = rig.laser.status
    trouble = ["interlock open"] if status.interlock_closed is False else []
    trouble += [] if status.fault is None else [f"fault {status.fault}"]
    trouble += ["key off"] if status.key_on is False else []
    interlock = "closed" if status.interlock_closed else "not known"
    state = ", ".join(trouble) or f"interlock {interlock}, no fault, input {status.input_mode}"
    if rig.laser.gate_only:
        state = "cannot be asked, and only its gate ends its light: switch it on and off by hand"
    warm = "" if status.temperature_c is None else f", {status.temperature_c:.1f} C"
    most = f", up to {rig.laser.limits.max_power_w * 1e3:g} mW"
    return Finding("laser", not trouble, f"{rig.laser.identity}: {state}{warm}{most}")


def _calibration(rig: OpenRig) -> Finding:
    """Finding on the calibration. A rig without one can scan, but its maps have stripes and no depth."""
    file, model = rig.config.calibration, rig.model
    if model is None:
        return Finding("calibration", True, "none: a scan gives stripes but no depth")
    against = refusals(model, file, identity_of(rig), rig.config.calibration_max_age)
    if against:
        return Finding("calibration", False, f"{file}: {'; '.join(each.text for each in against)}; {NEXT}")
    made = model.identity
    said = "does not say of which rig it is: unchecked" if made is None else f"of this rig, made {made.created}"
    return Finding("calibration", True, f"{file}: {said}")


def _plan(plan: ScanPlan) -> Finding:
    """Finding on the plan, which is ok: one that exceeds the link's rate is refused before."""
    link = f"{plan.bytes_per_s / 1e6:.0f} MB/s"
    if plan.readout_bytes_per_s is not None:
        link = f"read out at {plan.readout_bytes_per_s / 1e6:.0f} MB/s"
    elif plan.link_bytes_per_s is not None:
        link += f" of the link's {plan.link_bytes_per_s / 1e6:.0f} MB/s"
    sweep = f"{plan.columns} columns x {plan.exposures} exposures in {digits(1e3 * float(plan.sweep_s))} ms"
    return Finding("plan", True, f"{sweep}, {link}")


def _frames(seen: DarkLook, plan: ScanPlan) -> list[Finding]:
    if not len(seen.records):
        text = f"no frame within {seen.seconds:.1f} s; check the SPAD's cable and trigger"
        return [Finding("frames", False, text)]
    lost, damaged = seen.counters.lost or 0, seen.counters.crc_errors or 0
    rate = f"{len(seen.records)} received at {seen.n_bytes / seen.seconds / 1e6:.0f} MB/s"
    return [
        Finding("frames", not lost and not damaged, f"{rate}, {lost} lost, {damaged} damaged"),
        Finding(
            "dark counts", seen.dark_share < MOST_DARK, f"{seen.dark_share:.2%} of the pixels of a frame, gate low"
        ),
        _markers(seen, plan),
        _trigger(seen),
    ]


def _markers(seen: DarkLook, plan: ScanPlan) -> Finding:
    if plan.blanking is not None:
        return Finding("markers", True, "none: a scan finds its columns by a blanking pattern of the laser")
    lines = seen.lines(plan)
    markers = f"{_count(seen.records, Mark.SCAN)} scan and {_count(seen.records, Mark.LINE)} line markers"
    if lines is None:
        return Finding("markers", False, f"{markers} seen; check the scanner's marker lines")
    return Finding(
        "markers",
        lines.jitter_columns <= MOST_JITTER and abs(lines.clock_error) <= MAX_CLOCK_ERROR,
        f"{markers}, {lines.rate_hz:.6g} lines a second, jitter {lines.jitter_columns:.3g} columns, scanner's clock "
        f"{lines.clock_error * 1e6:+.0f} ppm against the SPAD's",
    )


def _trigger(seen: DarkLook) -> Finding:
    if seen.triggered:
        return Finding("trigger", True, "the scanner's scan marker starts the sync source's program")
    text = "no scan marker came to the sync source's trigger input, its gate would stay low; check that line"
    return Finding("trigger", False, text)


def _disk(folder: Path) -> Finding:
    """Finding on the disk: free space, and how fast a file is written there."""
    here = folder.resolve()
    while not here.exists():
        here = here.parent
    free = shutil.disk_usage(here).free
    try:
        with tempfile.NamedTemporaryFile(dir=here, prefix=".rig-doctor-") as file:
            piece = os.urandom(2**20)
            begun = time.perf_counter()
            for _ in range(WRITE_BYTES // len(piece)):
                file.write(piece)
            file.flush()
            os.fsync(file.fileno())
            rate = WRITE_BYTES / (time.perf_counter() - begun)
    except OSError as error:
        return Finding("disk", False, f"{here} cannot be written: {error.strerror or error}; choose another folder")
    room = "" if free >= LEAST_FREE_BYTES else f"; less than {LEAST_FREE_BYTES / 1e9:.1f} GB, make room"
    return Finding("disk", not room, f"{here}: {free / 1e9:.1f} GB free, {rate / 1e6:.0f} MB/s{room}")


KNOWN = (("helios", HELIOS), ("lasercube", LASERCUBE), *(("spb-usb", one) for one in USB_IDS))
"""USB devices by the kind of their driver. Devices on serial ports cannot be identified without being opened."""


@dataclass(frozen=True, slots=True)
class Attached:
    """One attached device.

    address: the value of a config's `port` for it. what: description for people. kind: kind of its driver; None for a
    serial port of any kind.
    """

    address: str
    what: str
    kind: str | None


def attached() -> list[Attached]:
    """List USB devices that a driver knows, NI cards that NI-DAQmx knows, Ether Dreams that broadcast, Pulse Streamers
    that answer, then serial ports. Opens nothing."""
    tell_stage("looking at USB and cards")
    found = [
        Attached(one.address, f"{kind}: {one.product_name or wanted.label}", kind)
        for kind, wanted in KNOWN
        for one in attached_usb(wanted)
    ]
    found += [Attached(name, f"nidaq: {model}", "nidaq") for name, model in attached_cards()]
    tell_stage("listening on the network")
    for address, heard in dict(broadcasts()).items():
        found.append(Attached(address, f"etherdream: MAC {heard.mac}, hardware {heard.hardware}", "etherdream"))
    for address, serial in dict(discover()).items():
        found.append(Attached(address, f"pulsestreamer: serial {serial}", "pulsestreamer"))
    for port in list_ports.comports():
        number = f", serial={port.serial_number}" if port.serial_number else ""
        found.append(Attached(port.device, f"serial port: {port.description}{number}", None))
    return found


def laser_off(config: RigConfig) -> list[str]:
    """Set the gate low and switch emission off; returns what was done.

    Both are tried even if one fails. Raises DevicesError, whose message names the failures first and then what was
    done. A laser that can only be switched off by hand counts as a failure. Also raises what `open_light` raises.
    """
    done: list[str] = []
    trouble: list[str] = []
    with open_light(config, trouble) as (sync, laser):
        if laser is not None and laser.gate_only:
            trouble.append(
                f"laser: {laser.name} cannot be switched off from here: only its gate ends its light; switch "
                "it off by hand"
            )
            laser = None
        for slot, device, switch, what in (
            ("sync", sync, "abort", "all outputs low"),
            ("laser", laser, "disarm", "emission off"),
        ):
            try:
                if device is not None:
                    getattr(device, switch)()
                    done.append(f"{device.name}: {what}")
            except Exception as error:  # a driver's own fault must not keep the laser on
                trouble.append(f"{slot}: {error}")
    if trouble:
        raise DevicesError("\n".join(trouble) + (f" (done: {', '.join(done)})" if done else ""))
    return done
