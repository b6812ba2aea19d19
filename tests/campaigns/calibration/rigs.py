"""Random rigs calibrated from boards shown to them: is the depth as good as the calibration says it is?

    python -m tests.campaigns.calibration.rigs --rigs 500 --workers 2

Every rig is its own (`tests.reference.boards.random_rigs`), is shown 10 to 16 poses, and swept both ways at K = 10
(every fourth pose at K = 3 too, which tells the lags apart). Frames come from the simulator's photons, are counted as
in a scan, and go the way of `rig calibrate planes`: picture, corners, passages, fit. The fitted model's depth is then
compared with the true model's, for the same pixels and commands, at points 5 m away spread over the picture. Per rig:
median and worst error, error over the stated standard deviation, whether the true depth lies in the stated 95 %
interval, and what the model adds to a scan's error in pixels at K = 10, 1 and 20, both ways. Rigs that were refused
are listed. Making the views takes nearly all of the time: `--views FOLDER` keeps them, and takes them from there where
they are, with the corners found anew. Exit code 1 where a figure is not what is asked for.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.board.board import Board
from calibration.board.detect import find_corners
from calibration.depth_error import command_at, depth_sd_m
from calibration.errors import CalibrationError, Degenerate
from calibration.model.light_sheet import depth_slope
from calibration.model.rig_model import RigModel
from calibration.passages.find import SweepCounts, board_pixels, even_pixels, evenly, find_passages, flux_picture
from calibration.rig_fit.fit import fit_rig
from calibration.views import Passages, View, robust_sd
from rig.batch.case import Case
from rig.calibrate.session import load_views, save_view
from sim_backend.effects.dark_counts import dark_rates
from sim_backend.light.optics import Sensor
from sim_backend.scenes.board import BoardAtPose
from tests.campaigns.calibration.asked import ADDED_PX, INSIDE, RATIO, Figure, exit_code
from tests.campaigns.calibration.board_capture import (
    FRAME_S,
    HOT_PER_S,
    Stand,
    SweepAsked,
    SweepTaken,
    set_up,
    speed,
    take_sweeps,
)
from tests.campaigns.studies import add_options, results_of
from tests.reference.boards.random_rigs import BOARD, random_poses, random_rig

FAR_M = 5.0
GRID = 12
"""Points along each side of the picture."""
CALIBRATED, SCANNED = 10, (10, 1, 20)
"""Exposures of the views, and of the scans that the model is for."""
SURE = 1.959964
"""Standard deviations of a 95 % interval."""


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """A fitted model against the truth, at points (n,) of the picture. error_m, sd_m: at FAR_M. added_px: by exposures
    and direction, root mean square over the picture of what the model adds to a scan's error.
    """

    error_m: Array
    sd_m: Array
    added_px: dict[tuple[int, int], float]


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Calibration of a rig. trouble: why there is no model, '' where there is one. outliers: views that the fit left
    out.
    """

    seed: int
    seconds: float
    trouble: str
    poses: int = 0
    compared: Compared | None = None
    outliers: Sequence[str] = ()

    @classmethod
    def of(cls, result: Mapping[str, Any]) -> Outcome:
        """The outcome in the result of `calibrated`."""
        compared = None
        if result["error_m"] is not None:
            added = {(k, direction): px for k, direction, px in result["added_px"]}
            compared = Compared(np.array(result["error_m"]), np.array(result["sd_m"]), added)
        told = (result[name] for name in ("trouble", "poses"))
        return cls(result["seed"], result["measured"]["seconds"], *told, compared, result["outliers"])

    def __str__(self) -> str:
        """One line."""
        c = self.compared
        if c is None:
            return f"{self.seed}: {self.trouble} ({self.seconds:.1f} s)"
        return (
            f"{self.seed}: error {1e3 * np.median(np.abs(c.error_m)):.2f} mm, sd {1e3 * np.median(c.sd_m):.2f} mm, "
            f"ratio {np.sqrt(np.mean((c.error_m / c.sd_m) ** 2)):.2f} ({self.seconds:.1f} s)"
        )


def compare(fitted: RigModel, true: RigModel) -> Compared:
    """The fitted model's depth against the true one's, for the same pixels and commands."""
    camera = true.camera
    x, y = np.meshgrid(*((np.arange(GRID) + 0.5) / GRID * size - 0.5 for size in (camera.width, camera.height)))
    mirror = command_at(true, x, y, FAR_M)
    there = np.isfinite(mirror)
    x, y, mirror = x[there], y[there], mirror[there]
    slope = np.abs(depth_slope(*camera.tangents_at(x, y), true.planes(mirror), camera))
    added, error, sd = {}, np.empty(0), np.empty(0)
    for exposures in SCANNED:
        for direction in (1, -1):
            velocity = direction * speed(exposures)
            lag_s = true.lag_s.forward if direction > 0 else true.lag_s.backward
            stands = fitted.mirror_command(mirror + velocity * lag_s, y, velocity)
            stands = np.clip(stands, *fitted.scanner.command_range)
            off = fitted.sheets(stands).depth(*fitted.camera.tangents_at(x, y)) - FAR_M
            added[exposures, direction] = float(np.sqrt(np.nanmean((off / slope) ** 2)))
            if exposures == CALIBRATED:
                error = np.concatenate([error, off])
                sd = np.concatenate([sd, depth_sd_m(fitted, x, y, stands, velocity)])
    return Compared(error, sd, added)


def summary(outcomes: Iterable[Outcome]) -> str:
    """The figures over all rigs."""
    done = list(outcomes)
    good = [(o, o.compared) for o in done if o.compared is not None]
    said = [f"{len(done)} rigs, {len(good)} calibrated, median {np.median([o.seconds for o in done]):.1f} s a rig"]
    said += [f"  refused, seed {o.seed}: {o.trouble}" for o in done if o.compared is None]
    if not good:
        return "\n".join(said)
    z = in_sds(c for _, c in good)
    medians = np.array([np.median(np.abs(c.error_m)) for _, c in good])
    worst = np.array([np.max(np.abs(c.error_m)) for _, c in good])
    inside = np.array([np.mean(np.abs(c.error_m) < SURE * c.sd_m) for _, c in good])
    spread = np.array([np.sqrt(np.mean((c.error_m / c.sd_m) ** 2)) for _, c in good])
    said += [
        f"depth error at {FAR_M:g} m, mm: median of the rigs' medians {1e3 * np.median(medians):.2f}, of their worst "
        f"{1e3 * np.median(worst):.2f}; worst of all {1e3 * worst.max():.1f}",
        f"error over stated sd: median {robust_sd(z):.3f}, rms {np.sqrt(np.mean(z**2)):.3f}, a rig's "
        f"rms {np.median(spread):.3f} (median), {np.percentile(spread, 95):.2f} (95 %), {spread.max():.2f} (worst)",
        f"true depth in the stated 95 % interval: {np.mean(np.abs(z) < SURE):.1%} of points; a rig's share "
        f"{np.percentile(inside, 5):.0%} (5 %)",
    ]
    for exposures in SCANNED:
        added = added_px((c for _, c in good), exposures)
        said.append(
            f"added to a scan at K = {exposures}, px: median {np.median(added):.4f}, 95 % "
            f"{np.percentile(added, 95):.4f}, worst {added.max():.4f}, above 0.1 px {np.mean(added > 0.1):.1%}"
        )
    odd = Counter(name for o, _ in good for name in o.outliers)
    said.append(f"views called outliers: {sum(odd.values())} of {sum(o.poses for o, _ in good)}")
    return "\n".join(said)


def in_sds(compared: Iterable[Compared]) -> Array:
    """Errors of all points of all rigs in stated standard deviations."""
    return np.concatenate([np.empty(0), *(c.error_m / c.sd_m for c in compared)])


def added_px(compared: Iterable[Compared], exposures: int) -> Array:
    """Pixels that each model adds to a scan's error, each way."""
    return np.array([c.added_px[exposures, direction] for c in compared for direction in (1, -1)])


def figures(compared: Sequence[Compared]) -> list[Figure]:
    """Figures beside what is asked for."""
    lost = 0.0 if compared else np.nan
    z = in_sds(compared) if compared else np.full(1, lost)
    inside = float(np.mean(np.abs(z) < SURE)) + lost
    return [
        Figure("depth error over its stated sd (median)", robust_sd(z), RATIO),
        Figure("share of true depths in the stated 95 % intervals", inside, INSIDE),
        *(
            Figure(
                f"px added to a scan at K = {k} (worst rig)", float(np.max([*added_px(compared, k), lost])), ADDED_PX
            )
            for k in SCANNED
        ),
    ]


PIXELS = 500
"""Pixels of a sweep that are looked at for passages."""
SLOW_EVERY, OTHER_SPEED = 4, 3


def view_of(name: str, stand: Stand, taken: Sequence[SweepTaken], board: Board) -> View:
    """The view that a capture makes of these sweeps; without corners where no board is found."""
    defects = stand.dark_per_s > HOT_PER_S
    picture = room_picture(stand, taken)
    try:
        corners = find_corners(picture, board, defects)
    except Degenerate:
        return View(name, None, (), picture)
    usable = even_pixels(picture) & board_pixels(corners, board, picture.shape) & ~defects
    return View(name, corners, tuple(_passages(sweep, usable) for sweep in taken), picture)


def counts_of(taken: SweepTaken) -> SweepCounts:
    """The counts in the form in which passages and pictures are found in them."""
    volume = taken.volume
    return SweepCounts(volume.counts, volume.n_frames, taken.command, volume.x0, volume.width)


def room_picture(stand: Stand, taken: Sequence[SweepTaken]) -> NDArray[np.float32]:
    """The picture (rows, width) of the sweeps, photons per exposure without dark counts, NaN outside the window."""
    picture = flux_picture(tuple(counts_of(sweep) for sweep in taken))
    return (picture - FRAME_S * stand.dark_per_s).astype(np.float32)


def views_of(stand: Stand, board: Board, poses: int, rng: np.random.Generator) -> list[View]:
    """The board at so many random poses, all swept."""
    views = []
    for i, pose in enumerate(random_poses(rng, stand.rig.model.camera, board, poses)):
        speeds = [CALIBRATED, OTHER_SPEED] if i % SLOW_EVERY == 0 else [CALIBRATED]
        sweeps = [SweepAsked(exposures, direction) for exposures in speeds for direction in (1, -1)]
        views.append(view_of(f"{i:03d}", stand, take_sweeps(stand, [BoardAtPose(board, pose)], sweeps, rng), board))
    return views


def found_anew(view: View, sensor: Sensor) -> View:
    """A kept view with the corners that are found in its picture today."""
    try:
        corners = find_corners(view.picture, BOARD, dark_rates(sensor, view.picture.shape) > HOT_PER_S)
    except Degenerate:
        return replace(view, corners=None, passages=())
    return replace(view, corners=corners)


def calibrated(seed: int, kept: str | None = None) -> dict[str, Any]:
    """Make a rig, calibrate it, compare: an `Outcome` as plain values. kept: a folder of views, one folder a rig."""
    result: dict[str, Any] = {"seed": seed, "trouble": "", "poses": 0, "error_m": None, "outliers": []}
    rng = np.random.default_rng(seed)
    rig = random_rig(rng)
    camera = rig.model.camera
    folder = None if kept is None else Path(kept) / f"{seed:05d}"
    if folder is not None and folder.is_dir():
        views = [found_anew(view, Sensor(pixel_seed=rig.pixel_seed)) for view in load_views(folder)]
    else:
        views = views_of(set_up(rig), BOARD, int(rng.integers(10, 17)), rng)
        if folder is not None:
            _keep(views, folder)
    try:
        fit = fit_rig(views, BOARD, (camera.width, camera.height))
        compared = compare(fit.model, rig.model)
    except CalibrationError as error:
        return {**result, "trouble": f"{getattr(error, 'reason', 'error')}: {error}"}
    added = [[k, direction, px] for (k, direction), px in compared.added_px.items()]
    found = {"error_m": compared.error_m, "sd_m": compared.sd_m, "added_px": added}
    return {**result, **found, "poses": len(views), "outliers": list(fit.outliers)}


def _keep(views: Sequence[View], folder: Path) -> None:
    part = folder.with_name(f".{folder.name}.part")
    part.mkdir(parents=True, exist_ok=True)
    for number, view in enumerate(views):
        save_view(view, part / f"{number:03d}.npz")
    part.rename(folder)


def _passages(taken: SweepTaken, usable: NDArray[np.bool_]) -> Passages:
    thinned = np.zeros_like(usable)
    thinned[tuple(evenly(usable)[:PIXELS].T)] = True
    return find_passages(counts_of(taken), taken.asked.direction, taken.asked.speed_per_s, thinned)


def main() -> int:
    """Run the campaign; 1 where a figure is not what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=500)
    parser.add_argument("--first", type=int, default=1, help="seed of the first rig")
    add_options(parser)
    parser.add_argument("--views", type=Path, metavar="FOLDER", help="where views are kept, to be fitted anew")
    asked = parser.parse_args()
    kept = None if asked.views is None else str(asked.views.absolute())
    seeds = range(asked.first, asked.first + asked.rigs)
    cases = [Case("tests.campaigns.calibration.rigs:calibrated", {"seed": n, "kept": kept}, {"seed": n}) for n in seeds]
    found = results_of(cases, asked.workers, asked.out)
    outcomes = [Outcome.of(result) for result in found if result is not None]
    for outcome in outcomes:
        print(outcome)
    print(summary(outcomes))
    short = exit_code(figures([o.compared for o in outcomes if o.compared is not None]))
    return short or int(len(outcomes) < len(found))


if __name__ == "__main__":
    sys.exit(main())
