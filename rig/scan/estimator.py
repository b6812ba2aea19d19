"""Chooses the estimator of a run with `auto`: `joint` wherever it keeps up with the frames and has memory enough, else
`likelihood`. Finds what `joint` has learned in an earlier run.

`joint` errs several times less than `likelihood` and takes longer. Its time does not matter if no frame waits for a
map: with a SPAD that can wait, such as a simulated one, with cubes, with recordings that are not played at a set speed,
and for a single map. In a stream a map must be made within the time of a sweep. How fast `joint` is on this machine and
with these threads is measured just before the scan.
"""

import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.errors import digits
from drivers.cores import cores
from rig.config.models import AUTO, EstimateConfig
from rig.count.volume import CountVolume
from rig.errors import UsageError
from rig.estimate.row.model import RowModel
from rig.geometry.windows import SweepGeometry
from rig.run_folder.folder import read_learned

KEPT_UP = 0.5
"""Share of a sweep's time that a map of `joint` may take; the rest is for counting and for other load."""
ROWS, COLUMNS = 128, 160
"""Largest part of the picture whose map is timed. Its map takes some milliseconds."""
EXPOSURES = 10
TRIES = 3


def choose_estimator(
    estimate: EstimateConfig, geometry: SweepGeometry, map_time_s: float = math.inf
) -> tuple[EstimateConfig, str]:
    """Replace `auto` in the settings; returns the settings and the reason of the choice. Without `auto` the settings
    are unchanged and the reason is empty.

    map_time_s: seconds in which a map must be made; infinite if no frame waits for it. If finite, `joint` may be timed
    first.
    """
    if estimate.estimator != AUTO:
        return estimate, ""
    name, why = _choice(estimate, geometry, map_time_s)
    return estimate.model_copy(update={"estimator": name}), why


def foreseen_estimator(estimate: EstimateConfig, geometry: SweepGeometry, map_time_s: float) -> str:
    """The estimator of a run in words, as far as it is known before `joint` is timed.

    map_time_s: as in `choose_estimator`.
    """
    chosen, why = choose_estimator(estimate, geometry)
    if why and chosen.estimator == "joint" and math.isfinite(map_time_s) and not estimate.temporal_prior:
        return f"auto: joint if this machine makes a map in {digits(1e3 * KEPT_UP * map_time_s, 2)} ms, else likelihood"
    return f"auto: {chosen.estimator}, {why}" if why else chosen.estimator


def _choice(estimate: EstimateConfig, geometry: SweepGeometry, map_time_s: float) -> tuple[str, str]:
    from rig.estimate.joint.tables import grid_of

    if estimate.temporal_prior:
        return "joint", "it alone has a temporal prior"
    try:
        grid_of(geometry)
    except UsageError:
        return "likelihood", "joint would take too much memory"
    if math.isinf(map_time_s):
        return "joint", "no frame waits for its maps"
    took_s = time_of_map(geometry, estimate.threads or cores())
    name = "joint" if took_s <= KEPT_UP * map_time_s else "likelihood"
    return name, f"a map of joint takes {digits(1e3 * took_s, 2)} ms, a sweep {digits(1e3 * map_time_s, 2)} ms"


def kept_model(file: Path | None, estimator: str, geometry: SweepGeometry) -> tuple[RowModel | None, str]:
    """The state of `joint` that an earlier run kept in a file, and an empty text; or None, and why no state can be
    used.

    Without a file, and for other estimators, the result is None and an empty text. Raises UsageError if the file is not
    readable, or its folder does not exist.
    """
    from rig.estimate.online_learning import LearningSetting
    from rig.estimate.row.em import path_bins

    if file is None or estimator != "joint":
        return None, ""
    if not file.parent.is_dir():
        raise UsageError(f"learned {file}: there is no folder {file.parent}; make it, or name another file")
    if not file.exists():
        return None, f"anew, {file} is written at the end"
    model = read_learned(file)
    try:
        LearningSetting(model, geometry, 1, True)
    except UsageError:
        return None, f"anew: {file} was learned from frames or columns of another size or number"
    if (model.w_lo, model.per_w) != path_bins(geometry):
        return None, f"anew: {file} was learned for another depth range"
    return model, ""


def time_of_map(geometry: SweepGeometry, threads: int) -> float:
    """Seconds per map of `joint` on this machine while each thread makes one map, as in a stream.

    The time is measured on a part of the picture and scaled up. A run's first map, from which `joint` learns, takes
    longer; so do maps with a halo.
    """
    from rig.estimate.joint.joint import Joint, MapWork
    from rig.estimate.row.em import start_model

    part = _middle(geometry)
    rate = np.full((part.columns, part.rows, part.window), 0.05)
    column, row = np.meshgrid(np.arange(part.columns), np.arange(part.rows), indexing="ij")
    # If a row sees nothing of a column, x_lo and x_hi describe an empty window that may lie outside: clip.
    middle = (part.x_lo + part.x_hi).T // 2 - part.x0[:, None]
    rate[column, row, np.clip(middle, 0, part.window - 1)] = 0.95
    sweep = CountVolume(
        counts=np.random.default_rng(0).binomial(EXPOSURES, rate).astype(np.uint8), x0=part.x0,
        n_frames=np.full(part.columns, EXPOSURES, np.int32), column=np.arange(float(part.columns)),
        dark_counts=None, n_dark=0, width=part.width, exposures=EXPOSURES,
    )  # fmt: skip
    model = start_model(sweep, part, np.full((part.rows, part.width), 0.05, np.float32), 0.0)
    joint, took_s = Joint(threads, model, learns=False), []
    at_once = max(min(threads, joint.most_at_once(geometry)), 1)
    works = [joint.begin(sweep, part, joint.solver()) for _ in range(at_once)]
    with ThreadPoolExecutor(at_once) as pool:
        for _ in range(1 + TRIES):
            begun = time.perf_counter()
            list(pool.map(MapWork.run, works))
            took_s.append(time.perf_counter() - begun)
    return min(took_s[1:]) / at_once * (geometry.rows * geometry.columns) / (part.rows * part.columns)


def _middle(geometry: SweepGeometry) -> SweepGeometry:
    """The middle rows and columns of a sweep, or all of them if they are few."""
    rows, columns = (
        slice((whole - min(whole, most)) // 2, (whole + min(whole, most)) // 2)
        for whole, most in ((geometry.rows, ROWS), (geometry.columns, COLUMNS))
    )
    return replace(
        geometry, u=geometry.u[rows], v=geometry.v[rows], plane=geometry.plane[columns],
        planes=geometry.planes[columns], x_lo=np.ascontiguousarray(geometry.x_lo[rows, columns]),
        x_hi=np.ascontiguousarray(geometry.x_hi[rows, columns]), x0=geometry.x0[columns],
        defects=geometry.defects[rows], light=None,
        others=None if geometry.others is None else geometry.others[columns],
    )  # fmt: skip
