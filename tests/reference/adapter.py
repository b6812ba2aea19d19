"""The only place where the yardstick touches the project: counts and calibration files in, stripe table out."""

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.reference.geometry import DEPTH_RANGE_M
from tests.reference.working_point import WorkingPoint


def reconstruct(
    point: WorkingPoint,
    counts: NDArray[np.unsignedinteger],
    exposures: int,
    *,
    estimator: str = "likelihood",
    filters: Sequence[str] = ("none",),
    threads: int = 2,
) -> list[Any]:
    """The project's MapResult of one map of counts (columns, H, W) with each filter, estimated once."""
    maker = reconstructor_of(point, estimator, threads=threads)
    volume = volume_of(maker, windowed(counts, maker.geometry.x0, maker.geometry.window), exposures)
    return filtered_maps(maker, volume, filters)


def filtered_maps(reconstructor: Any, volume: Any, filters: Sequence[str]) -> list[Any]:
    """The MapResult of a volume with each filter, estimated once."""
    begun = time.perf_counter()
    stripe = reconstructor.estimator.estimate(volume, reconstructor.geometry)
    estimate_s = time.perf_counter() - begun
    return [reconstructor.complete(stripe, volume, filter, estimate_s) for filter in filters]


def reconstructor_of(
    point: WorkingPoint, estimator: str, *, threads: int = 2, lines: Any = None, temporal_prior: bool = False
) -> Any:
    """The project's Reconstructor for the rig of a working point, whose calibration it reads from a file.

    It has learned nothing yet. lines: a LineGrid.
    """
    from calibration.files.rig_file import load_rig_model
    from rig.config.models import EstimateConfig
    from rig.depth.reconstruct import Reconstructor, map_geometry

    with tempfile.TemporaryDirectory() as folder:
        model = load_rig_model(point.write_calibration(Path(folder)))
    commands = np.arange(point.geometry.columns, dtype=np.float64)
    estimate = EstimateConfig(
        estimator=estimator, filter="none", min_confidence=0.5, threads=threads, temporal_prior=temporal_prior
    )
    geometry = map_geometry(model, commands, DEPTH_RANGE_M, lines=lines)
    return Reconstructor(model, commands, geometry, estimate, lines=lines)


def depth_with_floating(reconstructor: Any, result: Any) -> NDArray[np.float32]:
    """The depth map of a MapResult of this reconstructor before points that float were left out."""
    from rig.depth.depth import depth_map

    return np.asarray(depth_map(result.stripe, reconstructor.geometry, 0.5).depth_m)


def volume_of(reconstructor: Any, counts: NDArray[np.unsignedinteger], exposures: int) -> Any:
    """One sweep of counts (columns, H, window) in the reconstructor's windows."""
    from rig.count.volume import CountVolume

    columns = counts.shape[0]
    return CountVolume(
        counts=counts,
        x0=reconstructor.geometry.x0,
        n_frames=np.full(columns, exposures, np.int32),
        column=np.arange(columns, dtype=np.float64),
        dark_counts=None,
        n_dark=0,
        width=reconstructor.geometry.width,
        exposures=exposures,
    )


def windowed(counts: NDArray[np.unsignedinteger], x0: NDArray[np.int32], window: int) -> Any:
    """The `window` pixels from x0 (columns,) on of counts (columns, H, W); zeros beyond the picture."""
    columns, height, width = counts.shape
    out = np.zeros((columns, height, window), counts.dtype)
    for c in range(columns):
        part = counts[c, :, x0[c] : min(width, x0[c] + window)]
        out[c, :, : part.shape[1]] = part
    return out
