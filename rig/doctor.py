"""Could a scan run? Opens everything, looks at frames with the gate low, and says what was found (`rig doctor`).

The mirror moves, as in a scan; no light leaves: the gate is low throughout and the laser is never armed.
"""

import os
import shutil
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceError
from drivers.frames import SUBFRAME_SHIFT, FrameBlock, Mark
from drivers.interfaces import MARKER_LINE
from drivers.ring import BlockRing
from rig.config import RigConfig
from rig.errors import DevicesError, RigError
from rig.scan_plan import ScanPlan
from rig.session import OpenRig, open_rig, prepare

RING_SLOTS = 8
LOOK_S = 30.0
"""Longest look at the stream."""
FILL_S = 5.0
MOST_JITTER = 0.05
"""Largest standard deviation of the line markers, in columns, with which frames can be bound to columns."""
MOST_DARK = 0.05
"""Largest share of ones with the gate low: more is daylight or a lamp on the sensor."""
WRITE_BYTES = 64 * 2**20
LEAST_FREE_BYTES = 2**30


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at. ok: False where a scan could not run like this."""

    name: str
    ok: bool
    text: str

    def as_json(self) -> dict[str, Any]:
        """For programs."""
        return asdict(self)


def examine(config: RigConfig, folder: Path) -> list[Finding]:
    """Look at everything; folder: where a scan would write. Raises nothing that a device can do wrong."""
    findings: list[Finding] = []
    try:
        with open_rig(config) as rig:
            findings += _devices(rig)
            plan, timing = prepare(rig)
            sweep = f"{plan.columns} columns x {plan.exposures} exposures in {plan.sweep_s * 1e3:.3g} ms"
            findings.append(Finding("plan", True, sweep))
            findings += _frames(rig, plan, timing.stride)
    except (RigError, DeviceError) as error:
        lines = str(error).splitlines() if isinstance(error, DevicesError) else [str(error)]
        findings += [Finding("devices", False, line) for line in lines]
    findings.append(_disk(folder))
    return findings


def _devices(rig: OpenRig) -> list[Finding]:
    info, status, scanner_fault = rig.spad.info, rig.laser.status, rig.scanner.status.fault
    link = "" if info.stream is None or not info.stream.bytes_per_s else f", {info.stream.bytes_per_s / 1e6:.0f} MB/s"
    found = [
        Finding("spad", True, f"{rig.spad.name}: {info.model} {info.serial}, {info.width} x {info.height} px{link}"),
        Finding("scanner", scanner_fault is None, f"{rig.scanner.name}: {scanner_fault or 'ready'}"),
        Finding("sync", True, f"{rig.sync.name}: resolution {rig.sync.resolution_s * 1e9:g} ns"),
    ]
    trouble = [
        text
        for bad, text in (
            (not status.interlock_closed, "interlock open"),
            (status.fault is not None, f"fault {status.fault}"),
            (status.key_on is False, "key off"),
        )
        if bad
    ]
    temperature = getattr(status, "temperature_c", None)
    warm = "" if temperature is None else f", {temperature:.1f} C"
    state = ", ".join(trouble) or f"interlock closed, no fault, input {status.input_mode}"
    found.append(Finding("laser", not trouble, f"{rig.laser.name}: {state}{warm}"))
    guard = "none: the laser is simulated" if rig.guard is None else f"process {rig.guard.pid} owns laser and gate"
    found.append(Finding("guard", True, guard))
    return found


def _frames(rig: OpenRig, plan: ScanPlan, stride: int) -> list[Finding]:
    """Run the scanner for a sweep with the gate low, and look at the frames."""
    rig.sync.gate_low()
    rig.scanner.load(plan.waveform, plan.scanner_repeats(1))
    ring = BlockRing(RING_SLOTS, stride)
    blocks: list[tuple[NDArray[np.void], float, int]] = []
    wanted = 2 * float(plan.frames_per_sweep)
    lead = 0.3 * float(plan.frame_rate_hz)
    frames = None if plan.burst_frames is None else int(min(plan.burst_frames, lead + wanted))
    begun = time.monotonic()
    with ring.reader("doctor") as reader:
        rig.spad.start(frames)
        try:
            rig.scanner.start()
            while time.monotonic() - begun < LOOK_S and rig.spad.fill(ring, FILL_S):
                block = reader.next(0.0)
                if block is not None and block.n_frames:
                    blocks.append((block.records.copy(), _share_of_ones(block), block.bits.nbytes))
                if _scans(blocks) >= 2:
                    break
        finally:
            rig.scanner.park()
            rig.spad.stop()
    seconds = time.monotonic() - begun
    if not blocks:
        return [Finding("frames", False, f"no frame within {seconds:.1f} s; check the SPAD's cable and trigger")]
    counters, n_bytes = rig.spad.counters, sum(size for _, _, size in blocks)
    dark = float(np.mean([share for _, share, _ in blocks]))
    return [
        Finding(
            "frames",
            not counters.crc_errors,
            f"{sum(len(records) for records, _, _ in blocks)} received at {n_bytes / seconds / 1e6:.0f} MB/s, "
            f"{counters.lost or 0} lost, {counters.crc_errors or 0} damaged",
        ),
        Finding("dark counts", dark < MOST_DARK, f"{dark:.2%} of the pixels of a frame, gate low"),
        _markers(np.concatenate([records for records, _, _ in blocks]), plan),
    ]


def _scans(blocks: list[tuple[NDArray[np.void], float, int]]) -> int:
    return sum(int(np.count_nonzero(records["marks"] & int(Mark.SCAN))) for records, _, _ in blocks)


def _share_of_ones(block: FrameBlock) -> float:
    bits = np.ascontiguousarray(block.bits[:1])
    return float(np.unpackbits(bits).mean())


def _markers(records: NDArray[np.void], plan: ScanPlan) -> Finding:
    if plan.blanking is not None:
        return Finding("markers", True, "none: a scan finds its columns by a blanking pattern of the laser")
    marks = records["marks"].astype(np.int64)
    at = np.flatnonzero(marks & int(Mark.LINE))
    scans = int(np.count_nonzero(marks & int(Mark.SCAN)))
    if len(at) < 3 or scans == 0:
        text = f"{scans} scan and {len(at)} line markers seen; check the scanner's marker lines"
        return Finding("markers", False, text)
    frames = at + ((marks[at] >> SUBFRAME_SHIFT) & 0xFF) / 256
    begins = int(np.flatnonzero(marks & int(Mark.SCAN))[0])
    planned = np.flatnonzero(plan.waveform.markers & MARKER_LINE) / float(plan.point_rate_hz)
    seen = frames[at >= begins][: len(planned)]
    planned = planned[: len(seen)]
    if len(seen) < 3:
        return Finding("markers", False, f"only {len(seen)} line markers behind a scan marker; check the marker lines")
    frames_per_s, offset = np.polyfit(planned, seen, 1)
    jitter = float(np.std(seen - (frames_per_s * planned + offset))) / plan.exposures
    error_ppm = (float(plan.frame_rate_hz) / frames_per_s - 1) * 1e6
    return Finding(
        "markers",
        jitter <= MOST_JITTER,
        f"{scans} scan and {len(at)} line markers, {1 / np.median(np.diff(planned)):.6g} a second, jitter {jitter:.3g} "
        f"columns, scanner's clock {error_ppm:+.0f} ppm against the SPAD's",
    )


def _disk(folder: Path) -> Finding:
    """Free space, and how fast a file is written there."""
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
    return Finding("disk", free >= LEAST_FREE_BYTES, f"{here}: {free / 1e9:.1f} GB free, {rate / 1e6:.0f} MB/s")
