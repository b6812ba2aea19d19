"""One trial: a scan of the simulated rig that two or three faults strike, and what is left of it, bit for bit."""

import atexit
import faulthandler
import functools
import gc
import json
import os
import shutil
import tempfile
import threading
import time
import zlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceError
from drivers.frames import FrameBlock
from drivers.recorded import RunRecording
from drivers.ring import BlockRing
from rig import api
from rig.errors import RigError
from rig.recording.repair import repair
from rig.recording.verify import verify
from rig.recording.writer import Recording as Recorder
from rig.run_folder.manifest import RunVerdict
from rig.scan.run import Run
from tests.campaigns.faults.injected import CLOCKS, FAULTS, OUT_OF_ORDER, SEEN, UNKNOWN_LOSS, Moment, Struck, struck
from tests.campaigns.wrong_inputs.recorded import Recording
from tests.campaigns.wrong_inputs.setting import OFF, WORSE, off
from tests.system.small_rig import config, write_rig

MAPS: Final = 4
EXPOSURES: Final = 6
SCENES: Final = ("street-clear", "street", "street-light-fog", "street-dense-fog")
ESTIMATORS: Final = ("argmax", "edge", "likelihood", "joint")
ALONE: Final = ("argmax", "edge")
"""Estimators that answer each column by itself: what they say outside of a gap may not change by a bit."""
DEADLINE_S: Final = 60.0
"""From the start of a scan that takes one or two seconds to whatever end it comes to, on a machine that is loaded."""
_HUNG_S: Final = 300.0
_FULL_VERDICT: Final = str(RunVerdict.COMPLETE)
_SETTLE_S: Final = 5.0
_STAGES: Final = {"spad source", "counting", "recorder", "monitor", "recording sync", "live feed"}

Maps = list[dict[str, NDArray[Any]]]


@dataclass(frozen=True)
class Base:
    """A scan that nothing disturbs. columns: of each frame, fractional, NaN where there is none. maps: what it made."""

    config: Path
    columns: NDArray[np.float64]
    maps: Maps
    truth: list[NDArray[np.float32]]
    sweeps: list[tuple[int, int]]


@dataclass
class Watched:
    """What a scan did before it ended. published: number of the first frame and checksum of each block that readers
    got. counted: blocks of which the recording said that they were written. given: maps that it said were complete."""

    published: list[tuple[int, int]] = field(default_factory=list)
    counted: int = 0
    given: list[int] = field(default_factory=list)


@functools.cache
def base_of(number: int, estimator: str) -> Base:
    """The undisturbed scan of this number; once in each process."""
    folder = Path(tempfile.mkdtemp(prefix="faults-base-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    content = config()
    content["world"]["scene"] = SCENES[number % len(SCENES)]
    content["scan"]["exposures"] = EXPOSURES
    content["estimate"] = {"estimator": estimator}
    file = write_rig(folder, content)
    run = folder / "run"
    found = api.scan(file, maps=MAPS, seed=number, out=run, record=True)
    assert found.summary.verdict is RunVerdict.COMPLETE, found.summary.verdict
    sweeps = [(each["first_frame"], each["end_frame"]) for each in _json(run / "manifest.json")["sweeps"]]
    truth = [np.load(each)["depth_m"] for each in sorted((run / "truth").glob("*.npz"))]
    return Base(file, Recording(run).columns(), maps_of(run), truth, sweeps)


def trial(seed: int, only: Sequence[str] = tuple(FAULTS)) -> dict[str, Any]:
    """The trial of this number, as a case: what struck, how the scan ended, and what is `wrong`."""
    faulthandler.dump_traceback_later(_HUNG_S, exit=True)
    try:
        return _trial(np.random.default_rng(seed), list(only))
    finally:
        faulthandler.cancel_dump_traceback_later()


def _trial(rng: np.random.Generator, only: list[str]) -> dict[str, Any]:
    estimator = str(rng.choice(ESTIMATORS, p=[0.4, 0.2, 0.2, 0.2]))
    number, records = int(rng.integers(4)), bool(rng.random() < 0.5)
    base = base_of(number, estimator)
    how_many = min(int(rng.choice([1, 2, 3], p=[0.2, 0.5, 0.3])), len(only))
    names = [str(name) for name in rng.choice(only, how_many, replace=False)]
    frames = base.sweeps[-1][1]
    moments = [Moment(np.random.default_rng(rng.integers(1 << 62)), int(rng.integers(frames)), frames) for _ in names]
    wrong: list[str] = []
    with ExitStack() as stack:
        out = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="faults-"))) / "run"
        handles, watched, begun_s = _handles(), Watched(), time.monotonic()
        with _watching(watched), struck(list(zip(names, moments, strict=True))) as faults:
            killed = next((one for one in faults if one.name == "monitor killed"), None)
            end, verdict, said = _scan(base, number, records, out, killed, wrong)
        took_s = time.monotonic() - begun_s
        if took_s > DEADLINE_S:
            wrong.append(f"hung: it took {took_s:.0f} s")
        came = [one for one in faults if one.came]
        told = verdict not in (_FULL_VERDICT, None) or end != "result"
        if told and not came:
            wrong.append(f"nothing struck it, and yet {end}, {verdict}")
        if end != "result" and came and not any(one.own_end for one in came):
            wrong.append(f"ended by a fault that may not end it: {said}")
        maps, figures = _judged(base, out, came, told, estimator, watched, wrong)
        if records:
            _judge_recording(out, watched, came, end, verdict, maps, wrong)
        wrong += _left(handles)
        if rng.random() < 0.3 or {"SPAD unplugged", "no memory"} & set(names):
            again = out.parent / "again"
            _scan(base, number, False, again, None, wrong)
            if not same_maps(maps_of(again), base.maps):
                wrong.append("the scan after it is not the undisturbed one")
    return {
        "faults": sorted(one.name for one in came), "estimator": estimator, "records": records, "end": end,
        "verdict": verdict, "told": told, "said": said[:300], "wrong": wrong, **figures,
        "measured": {"took_s": took_s},
    }  # fmt: skip


def _scan(
    base: Base, seed: int, records: bool, out: Path, killed: Struck | None, wrong: list[str]
) -> tuple[str, str | None, str]:
    """How a scan ends: 'result' or its error, its verdict, and what it said."""

    def monitor(view: object) -> None:
        if killed is not None:
            killed.came = True
            raise RuntimeError("the viewer is gone")

    try:
        result = api.scan(base.config, maps=MAPS, seed=seed, out=out, record=records, monitor=monitor)
    except (RigError, DeviceError, MemoryError) as error:
        said = [str(error), *getattr(error, "__notes__", [])]
        if any(not line and not isinstance(error, MemoryError) for line in said):
            wrong.append(f"an error without a word: {error!r}")
        summary = out / "summary.json"
        return type(error).__name__, verdict_in(out) if summary.exists() else None, " | ".join(said)
    except Exception as error:
        wrong.append(f"foreign: {type(error).__name__}: {error}")
        return "foreign", None, str(error)
    return "result", str(result.summary.verdict), "; ".join(str(each.reason) for each in result.summary.verdict_reasons)


def _judged(
    base: Base, out: Path, came: Sequence[Struck], told: bool, estimator: str, watched: Watched, wrong: list[str]
) -> tuple[Maps, dict[str, int]]:
    """The maps that are left, against the undisturbed ones; and how many are the same, and changed."""
    maps = maps_of(out) if out.exists() else []
    lost = [index for index in watched.given if index >= len(maps)]
    if lost:
        wrong.append(f"maps {lost} were complete and are lost")
    same = changed = silent_inside = 0
    for index, (found, usual) in enumerate(zip(maps, base.maps, strict=False)):
        if same_maps([found], [usual]):
            same += 1
            continue
        changed += 1
        if told:
            continue
        if not _altering(base, came, index) <= {*SEEN, *CLOCKS}:
            wrong.append(f"map {index} is another one, and nobody says so")
        outside = _outside(base, came, index)
        stripes = [name for name in found if name.startswith("stripe ")]
        differ = [name for name in stripes if not _equal_at(found[name], usual[name], outside)]
        if estimator in ALONE and differ:
            wrong.append(f"map {index} differs outside of the gap in {differ}, and nobody says so")
        error, before = (off([each["depth"]], [base.truth[index]]) for each in (found, usual))
        if error is not None and error > OFF and error > WORSE * (before or 0.0):
            if any(one.name in SEEN for one in came):
                silent_inside += 1
            else:
                wrong.append(f"map {index} is off by {error:.1%} and nobody says so")
    return maps, {"same": same, "changed": changed, "silent_inside": silent_inside}


def _altering(base: Base, came: Sequence[Struck], index: int) -> set[str]:
    """Faults that altered or took a frame of a map, or may have where none is known to."""
    first, end = base.sweeps[index]
    touching = {one.name for one in came for a, b in one.frames if a < end and (b is None or b > first)}
    return touching or {"none that is known"}


def _outside(base: Base, came: Sequence[Struck], index: int) -> NDArray[np.bool_]:
    """Columns (columns,) of a map of which no frame was altered, nor one of a neighbour."""
    first, end = base.sweeps[index]
    number = np.arange(first, end)
    altered = np.zeros(end - first, np.bool_)
    for one in came:
        for begin, last in one.frames:
            altered |= (number >= begin) & (number < (last if last is not None else end))
    columns = len(base.maps[0]["stripe x_px"][0])
    outside = np.ones(columns, np.bool_)
    column = np.round(base.columns[first:end][altered])
    column = column[np.isfinite(column)].astype(int)
    for beside in (-1, 0, 1):
        near = column + beside
        outside[near[(near >= 0) & (near < columns)]] = False
    return outside


def _equal_at(found: NDArray[Any], usual: NDArray[Any], columns: NDArray[np.bool_]) -> bool:
    return np.array_equal(found[:, columns], usual[:, columns], equal_nan=found.dtype.kind == "f")


def _judge_recording(
    out: Path, watched: Watched, came: Sequence[Struck], end: str, verdict: str | None, maps: Maps, wrong: list[str]
) -> None:
    """Blocks that were reported as written are there as they were published, and give the maps of the scan. Where the
    device gave blocks twice, in another order or with times that go back, `verify` says so, and none is invented."""
    if not out.exists():
        if watched.counted:
            wrong.append(f"{watched.counted} blocks were written and are lost")
        return
    odd = any(one.name in OUT_OF_ORDER for one in came)
    try:
        sound = end != "result" or not verify(out).problems
        if end != "result":
            repair(out)
        recording = RunRecording(out)
        found = [(block.header.first_frame, _crc(block)) for run in recording.runs for block in recording.blocks(run)]
        again = api.reconstruct(out, out=out.parent / "reconstructed").summary if end == "result" else None
    except (RigError, DeviceError) as error:
        if watched.counted and end == "result" and not odd:
            wrong.append(f"the recording of a scan that ended well cannot be read: {error}")
        return
    if odd:
        if set(found) - set(watched.published):
            wrong.append("the recording has blocks that were never published")
        if sound and end == "result" and len(found) < watched.counted:
            wrong.append(f"{watched.counted} blocks were written, {len(found)} are there, and nobody says so")
    else:
        if not sound and not any(one.name == UNKNOWN_LOSS for one in came):
            wrong.append("the recording of a scan that ended well is damaged")
        if len(found) < watched.counted:
            wrong.append(f"{watched.counted} blocks were written, {len(found)} are there")
        if found != watched.published[: len(found)]:
            wrong.append("blocks of the recording are not those that were published")
    if again is not None and not (odd and not sound):
        if not same_maps(maps_of(out.parent / "reconstructed"), maps):
            wrong.append(f"its recording gives other maps (the scan {verdict}, the recording {again.verdict})")
        if verdict != _FULL_VERDICT and str(again.verdict) == _FULL_VERDICT:
            wrong.append(f"the scan was {verdict}, its recording is complete")


def _watching(watched: Watched) -> ExitStack:
    """Patches that note what a scan does; innermost, so that they see what comes of the faults."""
    publish, close, add = BlockRing.publish, Recorder.close, Run.add

    def noted_publish(ring: BlockRing, block: FrameBlock) -> None:
        watched.published.append((block.header.first_frame, _crc(block)))
        publish(ring, block)

    def noted_close(recording: Recorder) -> None:
        try:
            close(recording)
        finally:
            watched.counted = recording.blocks

    def noted_add(run: Run, *args: Any, **named: Any) -> None:
        index = run.tally.maps
        add(run, *args, **named)
        watched.given.append(index)

    stack = ExitStack()
    for of, name, with_ in (
        (BlockRing, "publish", noted_publish),
        (Recorder, "close", noted_close),
        (Run, "add", noted_add),
    ):
        stack.enter_context(patch.object(of, name, with_))
    return stack


def _crc(block: FrameBlock) -> int:
    return zlib.crc32(block.bits.tobytes(), zlib.crc32(block.start_ticks.tobytes()))


def maps_of(folder: Path) -> Maps:
    """Depth and stripe table of each map of a run, by name."""
    found = []
    for file in sorted((folder / "stripe").glob("*.npz")):
        with np.load(file) as stripe:
            arrays = {f"stripe {name}": stripe[name] for name in stripe.files}
        depth = folder / "depth" / f"{file.stem}.npy"
        found.append({**arrays, "depth": np.load(depth)} if depth.exists() else arrays)
    return found


def same_maps(found: Maps, usual: Maps) -> bool:
    """Whether all maps are the same, bit for bit."""
    return len(found) == len(usual) and all(
        a.keys() == b.keys()
        and all(np.array_equal(a[name], b[name], equal_nan=a[name].dtype.kind == "f") for name in a)
        for a, b in zip(found, usual, strict=True)
    )


def _handles() -> int:
    return len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0


def _left(handles: int) -> Iterator[str]:
    """Threads and file handles that a scan left behind."""
    gc.collect()  # an error refers to what raised it
    ends_s = time.monotonic() + _SETTLE_S
    while left := sorted(each.name for each in threading.enumerate() if each.name in _STAGES):
        if time.monotonic() > ends_s:
            yield f"threads are left: {left}"
            return
        time.sleep(0.01)
    if (now := _handles()) > handles:
        yield f"{now - handles} file handles are left"


def verdict_in(run: Path) -> str:
    """The verdict in the summary of a run."""
    return str(_json(run / "summary.json")["verdict"])


def _json(file: Path) -> Any:
    return json.loads(file.read_text(encoding="utf-8"))
