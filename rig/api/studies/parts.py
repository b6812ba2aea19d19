"""Reconstruction of one recording in parts that are done at the same time, on this computer or on many."""

import shutil
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from calibration.errors import CalibrationError
from calibration.files.npy_files import load_arrays
from calibration.files.rig_file import CALIBRATION_FILE, load_rig_model
from rig.api.scans import replay
from rig.api.studies.batches import executor_of
from rig.batch.case import Case
from rig.batch.engine import run_batch
from rig.batch.pool import Limits
from rig.batch.store import Store
from rig.batch.task import FILES, SCRATCH
from rig.config.models import AUTO
from rig.config.overrides import PathLike
from rig.depth.knocks import KNOCKED, knocked
from rig.depth.reconstruct import map_geometry
from rig.errors import RigError, UsageError
from rig.estimate.registry import LEARNING
from rig.geometry.stripe_table import StripeTable
from rig.plan.calibration_reach import recalibrated
from rig.progress import Progress, tell_stage
from rig.recording.cut import cut
from rig.recording.inputs import read_plan
from rig.recording.open import map_spans, open_recording
from rig.requests import BatchRequest, ReconstructRequest
from rig.run_folder.folder import RunFolder
from rig.run_folder.joined import join_runs, with_doubt
from rig.run_folder.manifest import read_manifest
from rig.scan.run import RunResult, versions

if TYPE_CHECKING:
    from distributed import Client

MAPS_OF_A_PART: Final = 8
"""Maps of a part: it takes seconds, while half a second is lost on opening it. Independent of the number of workers,
so that an interrupted reconstruction goes on with any other number."""
OPTIONS: Final = "estimator", "filter", "min_confidence", "accept_calibration"


def reconstruct_parts(
    recording: PathLike,
    calibration: PathLike | None = None,
    request: ReconstructRequest | None = None,
    *,
    cluster: PathLike | None = None,
    workers: int | None = None,
    client: "Client | None" = None,
    progress: Progress | None = None,
) -> RunResult:
    """Make the depth maps of a recording in parts (`rig reconstruct --cluster`). The maps are those of `reconstruct`,
    bit for bit, and are in the request's `out`; the result holds none of them.

    An estimator that learns from map to map needs the states that the recording's scan has kept for each map. So the
    request must then name the estimator of that scan, or none, and the calibration must be the same. An interrupted
    reconstruction goes on where it stopped: finished parts are beside `out`, in a folder with `.parts` added to its
    name.

    Raises UsageError for a recording that cannot be done in parts, RigError if a part fails, and KeyboardInterrupt
    after an interrupt.
    """
    request, folder = request or ReconstructRequest(), Path(recording)
    if request.out is None:
        raise UsageError("parts of a recording are written into a folder; name one with `out`")
    out = Path(request.out).absolute()
    maps = _require_parts(folder, calibration, request)
    options = {name: getattr(request, name) for name in OPTIONS}
    file = None if calibration is None else str(Path(calibration).absolute())
    cases = [
        Case(
            f"{__name__}:reconstruct_part",
            {"recording": str(folder.absolute()), "first": first, "end": min(first + MAPS_OF_A_PART, maps),
             "calibration": file, "options": options},
            {"maps": f"{first}:{min(first + MAPS_OF_A_PART, maps)}"},
            (str(folder.absolute()), *([] if file is None else [file])),
            keeps=True,
        )
        for first in range(0, maps, MAPS_OF_A_PART)
    ]  # fmt: skip
    if len(cases) == 1:
        tell_stage(f"one part, since there are no more than {MAPS_OF_A_PART} maps: one process does it all")
    place = out.with_name(f"{out.name}.parts")
    asked = BatchRequest(out=place, cluster=cluster, workers=workers)
    with RunFolder(out) as target:  # claimed first: it may be impossible
        with Store(place, cases) as store:
            done = run_batch(store, executor_of(asked, store, Limits(), client), progress=progress)
            if done.verdict == "aborted":
                interrupt = KeyboardInterrupt()
                interrupt.add_note(f"{done.done} of {done.total} parts are done; run the same command again to go on")
                raise interrupt
            if done.verdict != "complete":
                said = done.reason or f"maps {done.failures[0].labels['maps']}: {done.failures[0].message}"
                raise RigError(f"{len(done.failures)} of {done.total} parts failed; {said}")
            summary, manifest = join_runs([place / FILES / name for name in store.names], target)
        seams = range(MAPS_OF_A_PART, maps, MAPS_OF_A_PART)
        if moved := _knocked_at(seams, target, folder, file or str(folder / CALIBRATION_FILE)):
            summary = with_doubt(summary, KNOCKED, moved)
        config = dict(manifest["config"])
        config["spad"] = {**config["spad"], "recording": str(folder.absolute())}
        devices = dict(manifest["devices"])
        devices["spad"] = {**devices["spad"], "name": f"replay of {folder.name}"}
        config["calibration"] = file or str(folder.absolute() / CALIBRATION_FILE)
        content = {**manifest, "config": config, "devices": devices, "parts": len(cases), "versions": versions()}
        target.write_json("manifest.json", {**content, "verdict": summary.verdict.value})
        target.write_json("summary.json", summary.as_json())
        published = target.publish()
    shutil.rmtree(place, ignore_errors=True)
    return RunResult(summary, None, None, published)


def reconstruct_part(
    recording: str, first: int, end: int, calibration: str | None, options: dict[str, Any], keep: str
) -> dict[str, Any]:
    """Make the maps `first` to `end` - 1 of a recording and write them as a run into the folder `keep`; returns figures
    of the run."""
    # Beside `keep`: if this process is killed, both are removed with the batch.
    part = Path(keep).with_name(f"{Path(keep).name.removesuffix(SCRATCH)}.frames{SCRATCH}")
    try:
        cut(recording, part, maps=f"{first}:{end}")
        result = replay(part, clock="max", calibration=calibration, out=keep, **options).uninterrupted()
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return {"maps": result.summary.maps, "verdict": result.summary.verdict.value, "fog": asdict(result.summary.fog)}


def _knocked_at(seams: Iterable[int], target: RunFolder, recording: Path, calibration: PathLike) -> list[int]:
    """Those of the maps, each the first of a part, before which the rig was knocked since the last map before it.

    Each part compares its own maps.
    """
    if not Path(calibration).exists():
        return []
    model = load_rig_model(calibration)
    plan = recalibrated(read_plan(recording), model)
    geometry = map_geometry(model, plan.commands, plan.depth_range_m, lines=plan.lines)
    found = []
    for seam in seams:
        files = (target.place("stripe") / f"{index:06d}.npz" for index in (seam - 1, seam))
        before, after = (StripeTable(**load_arrays(file)) for file in files)
        if knocked(before, after, geometry):
            found.append(seam)
    return found


def _require_parts(folder: Path, calibration: PathLike | None, request: ReconstructRequest) -> int:
    """The number of a recording's maps. Raises UsageError if its maps cannot be made independently of each other."""
    opened = open_recording(folder)
    manifest = read_manifest(folder) or {}
    maps = len(map_spans(opened, manifest))
    if not maps or not any(run.entries["sweep"].any() for run in opened.runs):
        raise UsageError(f"{folder} has no markers that tell its maps apart; reconstruct it without `cluster`")
    before = (manifest.get("config") or {}).get("estimate") or {}
    name = request.estimator or before.get("estimator")
    if name == AUTO or name is None:
        raise UsageError(f"{folder} does not say which estimator to use; name it with `estimator`")
    if name not in LEARNING:
        return maps
    why = ""
    if before.get("temporal_prior"):
        why = "each map is held to the one before it (temporal_prior)"
    elif name != before.get("estimator"):
        why = f"{name} learns from map to map, and the scan has kept the states of {before.get('estimator')}"
    elif any(not (folder / "learned" / f"{index:06d}.npz").exists() for index in range(maps)):
        why = f"{name} learns from map to map, and the states of some maps were not kept"
    elif calibration is not None and _fingerprint(calibration) != (manifest.get("calibration") or {}).get("id"):
        why = f"{name} learns from map to map, and what the scan has learned is for another calibration"
    if why:
        raise UsageError(
            f"{folder} cannot be done by parts: {why}; reconstruct it without `cluster`, or several as a study"
        )
    return maps


def _fingerprint(calibration: PathLike) -> str:
    try:
        return load_rig_model(calibration).fingerprint()
    except CalibrationError as error:
        raise UsageError(str(error)) from error
