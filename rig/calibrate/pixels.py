"""`rig calibrate pixels`: maps the pixels from dark frames and compares the map with the last one.

Dark frames come from the SPAD alone or from a recorded run, lit ones from a scan or a run. For dark frames nothing
moves and no light leaves: the gate is low, the laser is not armed, the scanner rests. They come in short starts of the
SPAD spread over some time, since the rate of a noisy pixel may jump within milliseconds or only within minutes.

The folder has pixels.npz (the map with its version), calibration.yaml (that of the config, if any, with the new defects
and dark rates), dark_rate.png, report.html and summary.json. The statistics are in `calibration.pixel_map`.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from calibration import pixel_map
from calibration.errors import CalibrationError, digits
from calibration.files.rig_file import CALIBRATION_FILE, load_rig_model, save_rig_model
from calibration.verdict import Reason, Verdict
from drivers.cores import cores
from drivers.frames import FrameBlock, frame_bytes
from drivers.interfaces import SpadInfo, SpadMode, SpadRequest
from drivers.recorded.segments import segment_files
from drivers.ring import BlockRing
from rig.calibrate.capture import plain, scan_sweeps
from rig.calibrate.report import dark_rate_picture, pixel_page
from rig.calibrate.session import EXIT_NOT_TRUSTWORTHY
from rig.config.models import RigConfig, ScanConfig
from rig.config.overrides import SIMULATED, Config, PathLike, configure
from rig.count.sweeps import SweepData
from rig.count.volume import BIN_DARK, CountVolume, SweepCounter, SweepLayout
from rig.devices.calibration_use import carry_notes, try_note
from rig.devices.open import OpenRig, light_problems, open_rig
from rig.errors import UsageError
from rig.geometry.windows import WORD_PX
from rig.progress import Progress, counted
from rig.recording.inputs import read_plan
from rig.recording.replay import replay_config
from rig.requests import PixelsRequest, ReplayRequest
from rig.run_folder.folder import RunFolder
from rig.run_folder.pictures import png_bytes
from rig.scan.monitor import Listeners, ScanProgress
from rig.scan.pipeline import JOIN_S
from rig.scan.source import Source, blocks
from rig.threads import RowWorkers

STARTS: Final = 32
"""Starts of the SPAD; the counts of each are one block of the statistics. More if its memory is too small for that."""
BLOCK_FRAMES: Final = 128
SPARE_SLOTS: Final = 4
"""Slots of the ring beyond those needed, so that nothing is lost if a device sends shorter blocks than requested."""
SILENCE_S: Final = 5.0
SPREAD_S: Final = 10.0
"""Seconds from the first start to the last one."""

Sums = tuple[NDArray[np.int64], NDArray[np.int64]]
"""For every pixel (rows, width): the number of frames in which it fired, and of all frames that contained it."""


@runtime_checkable
class CoversLens(Protocol):
    """A world that can cover the lens."""

    def cover_lens(self) -> None:
        """Let no light in, from the SPAD's next `configure` on."""
        ...


@dataclass(slots=True)
class SweepSums:
    """Adds up the dark and the lit frames of counted sweeps. `add` can be passed to a scan, as `Listeners.sweeps`."""

    tally: pixel_map.DarkTally | None = None
    lit: Sums | None = None

    def add(self, sweep: SweepData) -> None:
        """Add a sweep; its dark frames are one block of the statistics. Without dark frames or counts it is ignored."""
        volume = sweep.tally
        if not isinstance(volume, CountVolume) or volume.dark_counts is None:
            return
        shape = volume.dark_counts.shape
        self.tally = self.tally or pixel_map.DarkTally((shape[0], shape[1]))
        dark_frames = volume.n_dark if volume.dark_frames is None else volume.dark_frames
        self.tally.add(volume.dark_counts.astype(np.int64), np.asarray(dark_frames, np.int64))
        ones, frames = self.lit or (np.zeros(shape, np.int64), np.zeros(shape, np.int64))
        self.lit = ones + volume.intensity(), frames + _frames_in_windows(volume)


def take_dark(
    rig: OpenRig,
    frames: int,
    *,
    progress: Progress | None = None,
    covered: Callable[[], None] | None = None,
) -> tuple[pixel_map.DarkTally, float]:
    """Take `frames` frames in the dark, or a few more for equal starts; return their tally and exposure in s.

    covered: called first, so that a person covers the lens; not called if the rig's world covers it. May raise
    DeviceError.
    """
    if isinstance(rig.world, CoversLens):
        rig.world.cover_lens()
    elif covered is not None:
        covered()
    info = rig.spad.info
    burst = info.burst.capacity_frames if info.stream is None and info.burst is not None else None
    per_start = min(math.ceil(frames / STARTS), burst or frames)
    request = _request(rig.config.scan, info, per_start)
    timing = rig.spad.configure(request)
    rig.sync.gate_low()
    workers = RowWorkers(rig.config.estimate.threads or cores())
    # A layout for dark frames only: its one column is never counted.
    layout = SweepLayout(1, info.height, info.width, np.zeros(1, np.int32), WORD_PX, 1)
    counter = SweepCounter(layout, workers)
    tally = pixel_map.DarkTally((info.height, info.width))
    starts = math.ceil(frames / per_start)
    rest_s = max(0.0, (SPREAD_S - frames / float(request.frame_rate_hz)) / max(starts - 1, 1))
    told = counted("taking dark frames", "frames", progress)
    for start in range(starts):
        if start:
            rig.clock.sleep(rest_s)
        counter.reset()
        for block in _blocks(rig, per_start, timing.stride, request.block_frames):
            if n := block.n_frames:
                counter.add(block.bits, np.full(n, BIN_DARK, np.int32), np.zeros(n), np.zeros(n, np.int32))
        sums = counter.finish()
        if sums.dark_counts is not None:
            tally.add(sums.dark_counts.astype(np.int64), sums.n_dark)
        told((start + 1) * per_start, frames)
    return tally, float(timing.exposure_ticks / timing.tick_hz)


def take_sweeps(rig: OpenRig, maps: int | None = None, progress: Progress | None = None) -> SweepSums:
    """Take the frames of a scan with light, or of a recording. maps: number of sweeps; None: all of the recording. An
    interrupt is raised again at the end. Raises UsageError if no sweep has dark frames."""
    sums = SweepSums()

    def live(now: ScanProgress) -> None:
        if progress is not None:
            progress(now.frames, now.frames_planned)

    scan_sweeps(rig, maps, Listeners(sweeps=sums.add, live=live))
    if sums.tally is None:
        raise UsageError(f"{rig.spad.name} gave no sweep with dark frames in one piece; scan again")
    return sums


def _request(scan: ScanConfig, info: SpadInfo, frames: int) -> SpadRequest:
    """Request for full frames of the scan's exposure and rate, or slower if the link carries less."""
    rate = Fraction(scan.frame_rate)
    if info.stream is not None:
        rate = min(rate, Fraction(math.floor(info.stream.bytes_per_s / frame_bytes(info.width, info.height))))
    mode: SpadMode = "burst" if info.stream is None else "stream"
    return SpadRequest(rate, scan.exposure_s, mode, min(BLOCK_FRAMES, frames))


def _blocks(rig: OpenRig, frames: int, stride: int, block_frames: int) -> Iterator[FrameBlock]:
    """Yield the blocks of one start of `frames` frames. The ring has room for all of them."""
    ring = BlockRing(-(-frames // block_frames) + SPARE_SLOTS, stride)
    source = Source(rig.spad, ring, SILENCE_S, lambda: None)
    with ring.reader("pixels") as reader:
        rig.spad.start(frames)
        source.thread.start()
        try:
            yield from blocks(reader, source, SILENCE_S)
        finally:
            source.end()
            rig.spad.stop()
            source.join(JOIN_S)


def _frames_in_windows(volume: CountVolume) -> NDArray[np.int64]:
    """Number of frames (width,) in which each pixel of a row lay within the counted window."""
    window = volume.counts.shape[2]
    change = np.zeros(max(volume.width, int(volume.x0.max(initial=0)) + window) + 1, np.int64)
    np.add.at(change, volume.x0, volume.n_frames)
    np.add.at(change, volume.x0 + window, -volume.n_frames)
    return np.cumsum(change)[: volume.width]


MOST_LEAK: Final = 0.1
"""Correlation of neighbouring pixels' rates beyond which the lens was not covered; crosstalk makes 0.01."""
WORST_PRECISION: Final = 0.2
"""Relative standard deviation of a dark rate at the limit of hot pixels, beyond which they cannot be identified."""


@dataclass(frozen=True, slots=True, eq=False)
class PixelResult:
    """A map of the pixels (`found`) and its verdict.

    drift: change since the older map `against`; None without one.
    leak: correlation of neighbouring pixels' rates, a sign of light in the dark frames; 0 for a recorded run.
    folder, calibration: paths of the folder and of the changed calibration; None if they were not written.
    """

    found: pixel_map.PixelVersion
    drift: pixel_map.PixelDrift | None
    against: pixel_map.PixelVersion | None
    verdict: Verdict
    leak: float
    folder: Path | None = None
    calibration: Path | None = None

    @property
    def exit_code(self) -> int:
        """Exit code of the command line: 0, or 1 if this map cannot be trusted or the older one does not hold."""
        return 0 if self.verdict.passed else EXIT_NOT_TRUSTWORTHY

    def rows(self) -> list[tuple[str, str]]:
        """Figures for people, by name."""
        pixels = self.found.pixels
        dead = "not judged: no lit frames"
        if pixels.dead is not None:
            dead = f"{int(pixels.dead.sum())}; {pixels.lit_judged:.1%} are lit well enough to be judged"
        rows = [
            ("sensor", self.found.sensor),
            ("map", f"version {self.found.version}, id {self.found.id}, {self.found.created}"),
            ("frames", f"{pixels.frames} dark, {pixels.exposure_s * 1e6:.4g} us each"),
            ("dark rate", f"{digits(pixels.ordinary_per_s)} counts/s, of ordinary pixels"),
            ("hot", f"{int(pixels.hot.sum())} above {digits(float(np.nanmedian(pixels.limit_per_s)))} counts/s"),
            ("noisy", f"{int(pixels.noisy.sum())} jump; {pixels.judged:.1%} fire often enough to be judged"),
            ("dead", dead),
            ("defects", f"{int(pixels.defects.sum())} pixels, {pixels.defects.mean():.2%} of all"),
        ]
        if self.drift is not None and self.against is not None:
            rows += _drift_rows(self.drift, self.against)
        return rows

    def as_json(self) -> dict[str, Any]:
        """Return what summary.json holds, as plain values."""
        pixels, drift = self.found.pixels, self.drift
        changes = None
        if drift is not None:
            changes = {key: np.asarray(value).tolist() for key, value in asdict(drift).items()}
            changes |= {"correlation": None if np.isnan(drift.correlation) else drift.correlation}
            changes |= {"reasons": list(drift.reasons)}
        masks = {"hot": pixels.hot, "noisy": pixels.noisy, "dead": pixels.dead, "defects": pixels.defects}
        return {
            **{key: getattr(self.found, key) for key in ("sensor", "version", "id", "parent", "created")},
            "frames": pixels.frames,
            "exposure_s": pixels.exposure_s,
            "dark_rate_per_s": pixels.ordinary_per_s,
            "limit_per_s": float(np.nanmedian(pixels.limit_per_s)),
            **{key: None if mask is None else int(mask.sum()) for key, mask in masks.items()},
            "judged": pixels.judged,
            "lit_judged": pixels.lit_judged,
            "light_leak": self.leak,
            "drift": changes,
            "calibration": None if self.calibration is None else str(self.calibration),
            "verdict": self.verdict.as_json(),
        }


def pixel_verdict(pixels: pixel_map.PixelMap, drift: pixel_map.PixelDrift | None, leak: float) -> Verdict:
    """Judge whether the map may be believed and, if a `drift` is given, whether the older one still holds. Reasons
    begin with the root cause."""
    reasons = []
    if leak > MOST_LEAK:
        said = f"the rates of neighbouring pixels correlate by {leak:.2f}, in the dark by {MOST_LEAK:g} at most"
        reasons.append(Reason("room-light", said, leak, MOST_LEAK, "cover the lens and start again"))
    least = pixel_map.frames_for(float(pixel_map.hot_flux(pixel_map.SIGNAL, 0.0)), WORST_PRECISION)
    if pixels.frames < least:
        said = f"{pixels.frames} dark frames cannot tell hot pixels, at least {least} can"
        reasons.append(Reason("too-few-frames", said, pixels.frames, least, "take more frames"))
    if drift is not None:
        reasons += _drift_reasons(drift)
    return Verdict(not reasons, tuple(reasons))


def _drift_reasons(drift: pixel_map.PixelDrift) -> list[Reason]:
    again = "scan with the calibration written here"
    alike = 1.0 if drift.alike is None else drift.alike
    ratio, new = drift.ratio, drift.new_defects
    told = {
        "other-sensor": (
            f"{alike:.0%} of the hot pixels are hot again", alike, pixel_map.LEAST_ALIKE, "compare maps of one sensor",
        ),
        "dark-rate-drift": (f"dark rates are {ratio:.3g} times those before", ratio, pixel_map.MOST_RATIO, again),
        "new-defects": (f"{new:.2%} of the pixels became defects", new, pixel_map.MOST_NEW_DEFECTS, again),
    }  # fmt: skip
    return [Reason(code, *told[code]) for code in drift.reasons]


def _drift_rows(drift: pixel_map.PixelDrift, against: pixel_map.PixelVersion) -> list[tuple[str, str]]:
    alike = "" if drift.alike is None else f", {drift.alike:.0%} of its hot pixels are hot again"
    return [
        ("against", f"version {against.version}, id {against.id}, {against.created}{alike}"),
        ("drift", f"dark rates x {drift.ratio:.4g} ({drift.ratio_sigma:.1f} sd from none), {drift.changed:.2%} of the "
                  f"pixels changed by more than chance, correlation {drift.correlation:.3f}"),
        ("changed", f"{len(drift.became_hot)} became hot, {len(drift.became_dead)} dead, {len(drift.recovered)} "
                    "recovered"),
    ]  # fmt: skip


PIXELS_FILE: Final = "pixels.npz"
LIT_FRAMES: Final = 100
"""Frames taken with the line on each pixel: enough to judge a pixel that should fire in a third of them."""


def calibrate_pixels(
    source: Config = SIMULATED,
    request: PixelsRequest | None = None,
    *,
    covered: Callable[[], None] | None = None,
    progress: Progress | None = None,
    **changes: Any,
) -> PixelResult:
    """Map hot and noisy pixels and the dark rate from dark frames, dead ones from lit frames (`rig calibrate pixels`).

    source: a rig, or the folder of a recorded run.
    covered: called when a person has to cover the lens; it must return once that is done.

    The older map is the request's `against` or, without that, the one beside a rig's calibration; a note beside that
    calibration then says whether the older map still holds. Raises UsageError for a wrong request or file, DeviceError
    or DevicesError if devices fail.
    """
    request = replace(request or PixelsRequest(), **changes)
    path, frames = None if isinstance(source, RigConfig) else Path(source), request.frames
    recorded = path if path is not None and path.is_dir() and segment_files(path) else None
    config = plain(replay_config(recorded, ReplayRequest(clock="max")) if recorded else configure(source))
    problems = [] if not request.light or recorded else light_problems(config, request.arm)
    if frames is not None and frames < 1:
        problems.append(f"frames is {frames}; it must be at least 1")
    if problems:
        raise UsageError.of(problems)
    last = _last(request.against, config, recorded)
    folder = None if request.out is None else RunFolder(request.out)
    try:
        lit_sums = None if request.lit is None else _recorded_sums(Path(request.lit), progress)[1]
        if recorded:
            tally, own, sensor = _recorded_sums(recorded, progress)
            lit_sums, exposure_s = lit_sums or own, float(read_plan(recorded).exposure_s)
        else:
            if request.light:
                with open_rig(config, seed=request.seed) as rig:
                    lit_sums = take_sweeps(rig, math.ceil(LIT_FRAMES / config.scan.exposures), progress).lit
            with open_rig(config, seed=request.seed) as rig:
                sensor = _sensor(rig)
                wanted = frames or pixel_map.frames_for(float(pixel_map.hot_flux(pixel_map.SIGNAL, 0.0)))
                tally, exposure_s = take_dark(rig, wanted, progress=progress, covered=covered)
        pixels = pixel_map.judge_pixels(tally, exposure_s, lit=lit_sums)
        created = datetime.now(UTC).isoformat(timespec="seconds")
        number, parent = (1, None) if last is None else (last.version + 1, last.id)
        found = pixel_map.PixelVersion(pixels, number, created, parent, sensor)
        try:
            drift = None if last is None else pixel_map.pixel_drift(last.pixels, pixels)
        except CalibrationError as error:
            raise UsageError(str(error)) from error
        leak = 0.0 if recorded else pixel_map.light_leak(pixels)
        result = PixelResult(found, drift, last, pixel_verdict(pixels, drift, leak), leak)
        if request.against is None and drift is not None:
            _note(config, drift)
        return result if folder is None else _written(result, folder, None if recorded else config.calibration)
    finally:
        if folder is not None:
            folder.discard()


def _recorded_sums(run: Path, progress: Progress | None) -> tuple[pixel_map.DarkTally, Sums | None, str]:
    """Dark and lit sums of a recording's sweeps, and the name of the sensor that took them."""
    with open_rig(plain(replay_config(run, ReplayRequest(clock="max")))) as rig:
        sums, sensor = take_sweeps(rig, progress=progress), _sensor(rig)
    assert sums.tally is not None, "else it would have been refused"
    return sums.tally, sums.lit, sensor


def _sensor(rig: OpenRig) -> str:
    return f"{rig.spad.info.model} {rig.spad.info.serial}"


def _last(against: PathLike | None, config: RigConfig, recorded: Path | None) -> pixel_map.PixelVersion | None:
    """The older map: `against`, or that beside a live rig's calibration, or None. Raises UsageError if damaged."""
    if against is not None:
        path = Path(against)
        path = path / PIXELS_FILE if path.is_dir() else path
    elif config.calibration is not None and recorded is None:
        path = config.calibration.parent / PIXELS_FILE
        if not path.exists():
            return None
    else:
        return None
    try:
        return pixel_map.load_pixels(path)
    except CalibrationError as error:
        raise UsageError(str(error)) from error


def _note(config: RigConfig, drift: pixel_map.PixelDrift) -> None:
    """Note beside the config's calibration whether its older pixel map holds. A failure to write is only logged."""
    assert config.calibration is not None, "the older map lies beside it"
    try:
        model = load_rig_model(config.calibration)
        try_note(config.calibration, model, "pixels", passed=not drift.reasons, reasons=drift.reasons)
    except CalibrationError as error:
        raise UsageError(f"calibration: {error}") from error


def _written(result: PixelResult, folder: RunFolder, calibration: Path | None) -> PixelResult:
    """Write the folder's files. Raises UsageError if they cannot be written."""
    pixels = result.found.pixels
    try:
        pixel_map.save_pixels(result.found, folder.place(PIXELS_FILE))
        folder.place("dark_rate.png").write_bytes(png_bytes(dark_rate_picture(pixels)))
        if calibration is not None:  # the config's calibration with the new map, and earlier notes on it
            before, file = load_rig_model(calibration), folder.place(CALIBRATION_FILE)
            rate = np.nan_to_num(pixels.rate_per_s, nan=pixels.ordinary_per_s).astype(np.float32)
            after = replace(before, defects=pixels.defects, dark_rate_per_s=rate)
            save_rig_model(after, file)
            carry_notes(calibration, before, file, after, new_pixels=True)
    except CalibrationError as error:
        raise UsageError(f"calibration: {error}") from error
    except OSError as error:
        raise UsageError(f"cannot write {folder.path}: {error.strerror or error}; name another `out`") from error
    written = replace(
        result, folder=folder.path, calibration=None if calibration is None else folder.path / CALIBRATION_FILE
    )
    folder.write_text("report.html", pixel_page(pixels, result.rows(), result.verdict, result.drift, result.against))
    folder.write_json("summary.json", written.as_json())
    return replace(written, folder=folder.publish())
