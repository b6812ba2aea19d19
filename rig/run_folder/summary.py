"""The summary of a run, as in `--json` and summary.json: frames, times, fog, errors and a verdict."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal, NamedTuple

import numpy as np

from drivers.interfaces import SweepTruth
from drivers.replay.pace import PaceReport
from rig.depth.fog_meter import FogEstimate
from rig.depth.reconstruct import MapResult
from rig.geometry.stripe_table import depth_errors, stripe_errors
from rig.run_folder.manifest import RunVerdict
from rig.run_folder.time_of_day import RunTime

_LARGEST = {
    "ring_slots", "ring_bytes", "ring_high_water", "map_queue", "map_queue_high_water", "recorder_s", "recorder_blocks",
    "recorder_bytes",
}  # fmt: skip
"""If a run starts the SPAD several times, the largest value of these figures is taken; other figures are added up.
Those of the recorder grow from start to start, so that the largest is that of the whole run."""


@dataclass(frozen=True, slots=True)
class PipelineStats:
    """Figures of a pipeline during a run or at its end. Times are wall time in seconds; None means that there is no
    such stage.

    source_fill_s: the SPAD's `fill`, without source_wait_s. source_wait_s: waiting in `fill` for a free slot of the
    ring.
    ring_high_water: largest number of slots in use at one time, out of ring_slots, which take ring_bytes together.
    dropped_blocks, dropped_frames: those that found no free slot. counting_s: binding and counting.
    estimation_s: from counts to map, as `SharedTime` charges it.
    map_queue: number of finished maps that may wait for the caller. map_queue_high_water: most that waited at one time.
    map_wait_s: waiting for room among them.
    recorder_s: computing checksums and writing, summed over threads.
    monitor_updates: views shown. monitor_skipped_blocks: blocks that were not shown.
    """

    source_fill_s: float = 0.0
    source_wait_s: float = 0.0
    ring_slots: int = 0
    ring_bytes: int = 0
    ring_high_water: int = 0
    dropped_blocks: int = 0
    dropped_frames: int = 0
    counting_s: float = 0.0
    estimation_s: float = 0.0
    map_wait_s: float = 0.0
    map_queue: int = 0
    map_queue_high_water: int = 0
    recorder_s: float | None = None
    recorder_blocks: int | None = None
    recorder_bytes: int | None = None
    monitor_updates: int | None = None
    monitor_skipped_blocks: int | None = None

    def and_then(self, later: "PipelineStats") -> "PipelineStats":
        """The figures of the starts of the SPAD so far (these) and of a later start together."""
        joined: dict[str, Any] = {}
        for name in (each.name for each in fields(self)):
            values = [value for each in (self, later) if (value := getattr(each, name)) is not None]
            joined[name] = (max if name in _LARGEST else sum)(values) if values else None
        return PipelineStats(**joined)


@dataclass(frozen=True, slots=True)
class RunFrames:
    """Frames between the first and the last scan marker, including dark and fly-back ones; expected = received + lost.

    If a run ended before its last map, these are all frames that came or were lost; only `lit` is of its whole maps.
    crc_errors: blocks refused as damaged, out of order or of another size; None if the source does not say. lit: frames
    counted for columns.
    """

    expected: int = 0
    received: int = 0
    lost: int = 0
    crc_errors: int | None = 0
    lit: int = 0


@dataclass(frozen=True, slots=True)
class Synchronisation:
    """The binding of a run's frames to columns: by what, and how well (see `rig.count.bind.SweepClock`).

    residual_columns: largest residual of all sweeps, in columns; None if a sweep could not be checked. clock_error: of
    all sweeps, the one farthest from 0. detection_probability: for each sweep, the chance that a blanking pattern as
    bright as the sweep's is found; here the smallest of them. None if markers bound the frames.
    """

    by: Literal["markers", "blanking pattern"]
    residual_columns: float | None
    clock_error: float
    detection_probability: float | None


@dataclass(frozen=True, slots=True)
class Doubt:
    """A reason not to trust some maps of a run. maps: their numbers."""

    reason: str
    maps: tuple[int, ...]


Errors = Mapping[str, float | None]


@dataclass(frozen=True, slots=True)
class TruthErrors:
    """Errors against a known truth by name, such as 'mean_abs', in pixels and metres; 'within_1px' and 'missing' are
    shares.

    Each error is the mean over the maps, but the median over the maps if its name begins with 'median'. None if no map
    has a value."""

    stripe_error_px: Errors
    depth_error_m: Errors


@dataclass(frozen=True, slots=True)
class Summary:
    """A run in figures. Times are in seconds, of the sensor or the computer. None means no value.

    map_rate_hz: maps per second of the sensor's time. realtime_factor: the sensor's time divided by the computer's.
    valid_fraction: share of camera pixels with depth, mean of the maps. floating_points: number of points left out of a
    map because they float between two surfaces, mean of the maps; None if they are kept, or without depth. fog: of the
    last map. verdict_reasons: reasons against maps, found in the maps themselves. accepted_calibration: reasons against
    the calibration that the user accepted. estimator_why: why the run chose this estimator; empty if the user named it.
    learned: if a file for learned states was named, whether the first map was estimated with the state in it, and why
    if not; else empty. note, tags: given with the run, for people. time: when the maps were taken, where that is known.
    """

    maps: int
    map_rate_hz: float | None
    columns: int
    exposures: int
    estimator: str
    filter: str
    frames: RunFrames
    sensor_time_s: float
    compute_time_s: float
    realtime_factor: float | None
    valid_fraction: float | None
    floating_points: float | None
    fog: FogEstimate
    truth: TruthErrors | None
    verdict: RunVerdict
    stages: PipelineStats | None = None
    sync: Synchronisation | None = None
    replay: PaceReport | None = None
    verdict_reasons: tuple[Doubt, ...] = ()
    accepted_calibration: tuple[str, ...] = ()
    estimator_why: str = ""
    learned: str = ""
    note: str = ""
    tags: tuple[str, ...] = ()
    time: RunTime | None = None

    def as_json(self) -> dict[str, Any]:
        """The summary as plain values. `truth` and the fields after `verdict` are left out if empty or None."""
        content = asdict(self)
        content["verdict"] = self.verdict.value
        optional = (
            "truth", "stages", "sync", "replay", "verdict_reasons", "accepted_calibration", "estimator_why", "learned",
            "note", "tags", "time",
        )  # fmt: skip
        return {name: value for name, value in content.items() if value or name not in optional}


class _OfMap(NamedTuple):
    compute_s: float
    valid: float
    floating: int | None
    fog: FogEstimate
    errors: tuple[Errors, Errors] | None
    """Errors of stripe and depth; None if the truth is not known."""
    doubts: tuple[str, ...]


@dataclass(slots=True)
class MapTally:
    """Adds up the maps of a run as they come."""

    columns: int
    exposures: int
    estimator: str
    filter: str
    estimator_why: str = ""
    learned: str = ""
    note: str = ""
    tags: tuple[str, ...] = ()
    _maps: list[_OfMap] = field(default_factory=list)

    @property
    def maps(self) -> int:
        """Number of maps so far."""
        return len(self._maps)

    @property
    def fog(self) -> list[FogEstimate]:
        """The readings of the fog meter, map by map."""
        return [each.fog for each in self._maps]

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """Reasons against maps, each with the maps concerned."""
        of_reason: dict[str, list[int]] = {}
        for index, each in enumerate(self._maps):
            for reason in each.doubts:
                of_reason.setdefault(reason, []).append(index)
        return tuple(Doubt(reason, tuple(maps)) for reason, maps in of_reason.items())

    def add(self, result: MapResult, compute_s: float, truth: SweepTruth | None = None) -> None:
        """Count one map. compute_s: wall time of its counting and estimation."""
        valid = float(np.isfinite(result.depth_m).mean())
        errors = None
        if truth is not None:
            errors = stripe_errors(result.stripe.x_px, truth.x_px), depth_errors(result.depth_m, truth.depth_m)
        # In one step: with an interrupt the map is counted wholly or not at all.
        self._maps.append(_OfMap(compute_s, valid, result.floating, result.fog, errors, result.doubts))

    def summary(
        self,
        frames: RunFrames,
        sensor_time_s: float,
        verdict: RunVerdict,
        stages: PipelineStats | None = None,
        sync: Synchronisation | None = None,
        replay: PaceReport | None = None,
        accepted_calibration: tuple[str, ...] = (),
        time: RunTime | None = None,
    ) -> Summary:
        """Make the summary of the run so far."""
        errors = [each.errors for each in self._maps if each.errors is not None]
        truth = TruthErrors(*(over_maps(kind) for kind in zip(*errors, strict=True))) if errors else None
        compute_s = sum(each.compute_s for each in self._maps)
        floating = [each.floating for each in self._maps if each.floating is not None]
        return Summary(
            maps=self.maps,
            map_rate_hz=self.maps / sensor_time_s if sensor_time_s > 0 else None,
            columns=self.columns,
            exposures=self.exposures,
            estimator=self.estimator,
            filter=self.filter,
            frames=frames,
            sensor_time_s=sensor_time_s,
            compute_time_s=compute_s,
            realtime_factor=sensor_time_s / compute_s if compute_s > 0 else None,
            valid_fraction=statistics.fmean(each.valid for each in self._maps) if self._maps else None,
            floating_points=statistics.fmean(floating) if floating else None,
            fog=self._maps[-1].fog if self._maps else FogEstimate(),
            truth=truth,
            verdict=verdict,
            stages=stages,
            sync=sync,
            replay=replay,
            verdict_reasons=self.doubts,
            accepted_calibration=accepted_calibration,
            estimator_why=self.estimator_why,
            learned=self.learned,
            note=self.note,
            tags=self.tags,
            time=time,
        )


def over_maps(errors: Sequence[Errors]) -> Errors:
    """Errors of several maps together: the median if an error's name begins with 'median', else the mean. None if no
    map has a value."""
    combined: dict[str, float | None] = {}
    for key in errors[0]:
        known = [value for each in errors if (value := each[key]) is not None]
        middle = statistics.median if key.startswith("median") else statistics.fmean
        combined[key] = middle(known) if known else None
    return combined
