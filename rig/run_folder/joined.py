"""Joins runs of parts of a recording into the run of the whole recording.

Files of maps are moved and renumbered. Figures of the summary are those that one run would have: sums, means over all
maps, and the worst of all parts. Figures of stages and of the replay are left out. Only pictures of depth are drawn
again, since the first map sets the colours of all.
"""

import shutil
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from calibration.files.npy_files import load_array, load_arrays
from drivers.json_text import parse_json
from rig.depth.fog_meter import FogEstimate
from rig.geometry.stripe_table import depth_errors, stripe_errors
from rig.run_folder.folder import RunFolder
from rig.run_folder.manifest import MANIFEST, RunVerdict
from rig.run_folder.pictures import depth_limits, depth_picture, png_bytes
from rig.run_folder.summary import Doubt, Errors, RunFrames, Summary, Synchronisation, TruthErrors, over_maps
from rig.run_folder.time_of_day import RunTime

SUMMARY: Final = "summary.json"
GRAVEST: Final = (RunVerdict.UNSYNCHRONISED, RunVerdict.DOUBTFUL, RunVerdict.GAPS, RunVerdict.UNCALIBRATED)
"""Verdicts of parts, the gravest first; a run has the gravest of its parts."""
MOVED: Final = "depth", "confidence", "intensity", "stripe", "cloud", "learned", "truth"


def join_runs(parts: Sequence[Path], folder: RunFolder) -> tuple[Summary, dict[str, Any]]:
    """Move all maps of the parts into a run folder; returns summary and manifest of the whole, which are not written.

    parts: folders of runs, at least one, in order, each with all its maps; they lose the files of their maps. The
    manifest is that of the first part with the sweeps and gaps of all, and without verdict, counters and request.
    """
    first_map = 0
    limits: tuple[float, float] | None = None
    summaries, manifests, whole = [], [], _OfMaps()
    for part in parts:
        summary, manifest = (parse_json((part / name).read_bytes()) for name in (SUMMARY, MANIFEST))
        for index in range(int(summary["maps"])):
            depth_m = whole.add(part, index)
            limits = limits or (None if depth_m is None else depth_limits(depth_m))
            for kind in MOVED:
                for file in (part / kind).glob(f"{index:06d}.*"):
                    there = folder.place(kind) / f"{first_map + index:06d}{file.suffix}"
                    there.parent.mkdir(exist_ok=True)
                    shutil.move(file, there)
            if depth_m is not None and limits is not None:
                file = folder.place("depth") / f"{first_map + index:06d}.png"
                file.write_bytes(png_bytes(depth_picture(depth_m, limits)))
        summaries.append((first_map, summary))
        manifests.append(manifest)
        first_map += int(summary["maps"])
    return _summary(summaries, whole), _manifest(manifests)


def with_doubt(summary: Summary, reason: str, maps: Sequence[int]) -> Summary:
    """The summary with one more reason not to trust the maps with these numbers. The verdict becomes 'doubtful', unless
    it is 'unsynchronised'."""
    doubts = {doubt.reason: doubt.maps for doubt in summary.verdict_reasons}
    doubts[reason] = tuple(sorted({*doubts.get(reason, ()), *maps}))
    verdict = next(each for each in GRAVEST if each in (summary.verdict, RunVerdict.DOUBTFUL))
    return replace(summary, verdict=verdict, verdict_reasons=tuple(Doubt(*each) for each in doubts.items()))


class _OfMaps:
    """Figures of single maps, from their files."""

    def __init__(self) -> None:
        self.valid: list[float] = []
        self.errors: list[tuple[Errors, Errors]] = []

    def add(self, part: Path, index: int) -> Any:
        """Take note of a map; returns its depth, None without a calibration."""
        file = part / "depth" / f"{index:06d}.npy"
        depth_m = load_array(file) if file.exists() else None
        self.valid.append(0.0 if depth_m is None else float(np.isfinite(depth_m).mean()))
        truth = part / "truth" / f"{index:06d}.npz"
        if truth.exists():
            true, stripe = load_arrays(truth), load_arrays(part / "stripe" / f"{index:06d}.npz")
            found_m = np.full_like(true["depth_m"], np.nan) if depth_m is None else depth_m
            errors = stripe_errors(stripe["x_px"], true["x_px"]), depth_errors(found_m, true["depth_m"])
            self.errors.append(errors)
        return depth_m


def _summary(parts: Sequence[tuple[int, Mapping[str, Any]]], of_maps: _OfMaps) -> Summary:
    each = [summary for _, summary in parts]
    first, last = each[0], each[-1]
    maps, sensor_s = sum(one["maps"] for one in each), sum(one["sensor_time_s"] for one in each)
    compute_s = sum(one["compute_time_s"] for one in each)
    frames: dict[str, int | None] = {}
    for name in first["frames"]:
        known = [value for one in each if (value := one["frames"][name]) is not None]
        frames[name] = sum(known) if known else None
    doubts: dict[str, list[int]] = {}
    for first_map, one in parts:
        for doubt in one.get("verdict_reasons", ()):
            doubts.setdefault(doubt["reason"], []).extend(first_map + index for index in doubt["maps"])
    floating = [round(one["floating_points"] * one["maps"]) for one in each if one["floating_points"] is not None]
    verdicts = {one["verdict"] for one in each}
    syncs, times = [one["sync"] for one in each if "sync" in one], [one["time"] for one in each if "time" in one]
    return Summary(
        maps=maps,
        map_rate_hz=maps / sensor_s if sensor_s > 0 else None,
        **{name: first[name] for name in ("columns", "exposures", "estimator", "filter")},
        frames=RunFrames(**frames),  # type: ignore[arg-type]
        sensor_time_s=sensor_s,
        compute_time_s=compute_s,
        realtime_factor=sensor_s / compute_s if compute_s > 0 else None,
        valid_fraction=statistics.fmean(of_maps.valid),
        floating_points=sum(floating) / maps if floating else None,
        fog=FogEstimate(**last["fog"]),
        truth=TruthErrors(*map(over_maps, zip(*of_maps.errors, strict=True))) if of_maps.errors else None,
        verdict=next((each for each in GRAVEST if each.value in verdicts), RunVerdict.COMPLETE),
        sync=_sync(syncs) if syncs else None,
        verdict_reasons=tuple(Doubt(reason, tuple(numbers)) for reason, numbers in doubts.items()),
        accepted_calibration=tuple(first.get("accepted_calibration", ())),
        estimator_why=first.get("estimator_why", ""),
        time=_time(times) if times else None,
    )


def _sync(syncs: Sequence[Mapping[str, Any]]) -> Synchronisation:
    residuals = [one["residual_columns"] for one in syncs]
    found = [one["detection_probability"] for one in syncs if one["detection_probability"] is not None]
    return Synchronisation(
        by=syncs[0]["by"],
        residual_columns=None if None in residuals else max(residuals),
        clock_error=max((one["clock_error"] for one in syncs), key=abs),
        detection_probability=min(found) if found else None,
    )


def _time(times: Sequence[Mapping[str, Any]]) -> RunTime:
    unsure = [one["uncertainty_s"] for one in times if one["uncertainty_s"] is not None]
    whole = replace(RunTime(**times[0]), last_frame_utc=times[-1]["last_frame_utc"])
    return replace(whole, uncertainty_s=max(unsure) if unsure else None)


def _manifest(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The manifest of the first part with the sweeps, gaps and times of all."""
    whole = {key: value for key, value in parts[0].items() if key not in ("counters", "crc32", "verdict", "request")}
    whole["maps"] = sum(part["maps"] for part in parts)
    for name in ("sweeps", "gaps"):
        whole[name] = [item for part in parts for item in part.get(name, ())]
    return whole
