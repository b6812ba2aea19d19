"""Random rigs calibrated from boards shown to them: is the depth as good as the calibration says it is?

    python -m tests.campaigns.calibration.rigs --rigs 500 --processes 2

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
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.board.board import Board
from calibration.board.detect import find_corners
from calibration.errors import CalibrationError, Degenerate
from calibration.passages.find import SweepCounts, evenly, find_passages
from calibration.passages.flux_picture import board_pixels, even_pixels
from calibration.rig_fit.fit import fit_rig
from calibration.views import Passages, View
from rig.calibrate.session import load_views, save_view
from sim_backend.effects.dark_counts import dark_rates
from sim_backend.light.optics import Sensor
from sim_backend.scenes.board import BoardAtPose
from tests.campaigns.calibration.asked import exit_code
from tests.campaigns.calibration.board_capture import (
    FRAME_S,
    HOT_PER_S,
    Stand,
    SweepAsked,
    SweepTaken,
    set_up,
    take_sweeps,
)
from tests.campaigns.calibration.rig_figures import CALIBRATED, Outcome, compare, figures, summary
from tests.reference.boards.random_rigs import BOARD, random_poses, random_rig

PIXELS = 500
"""Pixels of a sweep that are looked at for passages."""
SLOW_EVERY, OTHER_SPEED = 4, 3
OFF_LINE = 8
"""Columns on either side of the line that do not count for the picture."""


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


def room_picture(stand: Stand, taken: Sequence[SweepTaken]) -> NDArray[np.float32]:
    """Picture in the room's light (rows, width), photons per exposure, NaN outside the window: as
    `calibration.passages.flux_picture` has it but for its care of windows that move."""
    ones, frames = np.zeros(taken[0].volume.counts.shape[1:], np.int64), 0
    for sweep in taken:
        counts, n = sweep.volume.counts, sweep.asked.exposures
        most, at = np.zeros_like(counts[0]), np.zeros(counts[0].shape, np.int64)
        for column, here in enumerate(counts):
            ones += here
            at[here > most] = column
            np.maximum(most, here, out=most)
        frames += n * (len(counts) - 2 * OFF_LINE - 1)
        for shift in range(-OFF_LINE, OFF_LINE + 1):
            ones -= np.take_along_axis(counts, np.clip(at + shift, 0, len(counts) - 1)[None], axis=0)[0]
    picture = np.full(stand.rays[0].shape, np.nan, np.float32)
    x0, window = int(taken[0].volume.x0[0]), taken[0].volume.counts.shape[2]
    inside = np.s_[:, x0 : x0 + window]
    room = -np.log1p(-np.clip(ones, 0, frames - 0.5) / frames)
    picture[inside] = room[:, : picture[inside].shape[1]]
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
    assert view.picture is not None
    try:
        corners = find_corners(view.picture, BOARD, dark_rates(sensor, view.picture.shape) > HOT_PER_S)
    except Degenerate:
        return replace(view, corners=None, passages=())
    return replace(view, corners=corners)


def calibrated(seed: int, kept: Path | None = None) -> Outcome:
    """Make a rig, calibrate it, compare. kept: a folder of views, one folder a rig."""
    begun = time.perf_counter()
    rng = np.random.default_rng(seed)
    rig = random_rig(rng)
    camera = rig.model.camera
    folder = None if kept is None else kept / f"{seed:05d}"
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
        return Outcome(seed, time.perf_counter() - begun, f"{getattr(error, 'reason', 'error')}: {error}")
    return Outcome(seed, time.perf_counter() - begun, "", len(views), compared, fit)


def _keep(views: Sequence[View], folder: Path) -> None:
    part = folder.with_name(f".{folder.name}.part")
    part.mkdir(parents=True, exist_ok=True)
    for number, view in enumerate(views):
        save_view(view, part / f"{number:03d}.npz")
    part.rename(folder)


def _passages(taken: SweepTaken, usable: NDArray[np.bool_]) -> Passages:
    volume, asked = taken.volume, taken.asked
    counts = SweepCounts(volume.counts, volume.n_frames, taken.command, volume.x0, volume.width)
    thinned = np.zeros_like(usable)
    thinned[tuple(evenly(usable)[:PIXELS].T)] = True
    return find_passages(counts, asked.direction, asked.speed_per_s, thinned)


def main() -> int:
    """Run the campaign; 1 where a figure is not what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=500)
    parser.add_argument("--first", type=int, default=1, help="seed of the first rig")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--views", type=Path, metavar="FOLDER", help="where views are kept, to be fitted anew")
    asked = parser.parse_args()
    outcomes = []
    with ProcessPoolExecutor(asked.processes) as pool:
        for outcome in pool.map(partial(calibrated, kept=asked.views), range(asked.first, asked.first + asked.rigs)):
            outcomes.append(outcome)
            print(_line(outcome), flush=True)
    print(summary(outcomes))
    return exit_code(figures([o.compared for o in outcomes if o.compared is not None]))


def _line(outcome: Outcome) -> str:
    if outcome.compared is None:
        return f"{outcome.seed}: {outcome.trouble} ({outcome.seconds:.1f} s)"
    c = outcome.compared
    z = np.sqrt(np.mean((c.error_m / c.sd_m) ** 2))
    return (
        f"{outcome.seed}: error {1e3 * np.median(np.abs(c.error_m)):.2f} mm, sd {1e3 * np.median(c.sd_m):.2f} mm, "
        f"ratio {z:.2f} ({outcome.seconds:.1f} s)"
    )


if __name__ == "__main__":
    sys.exit(main())
