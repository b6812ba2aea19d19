"""Deliberate mistakes in calibrating random rigs: does the verdict name them?

    python -m tests.campaigns.calibration.mistakes --trials 30 --workers 2

Per trial one random rig makes every mistake once, and none once. Frames come from the simulator's photons as in
`tests.campaigns.calibration.rigs`. What is named first counts: of a model the verdict's first reason, of views without
a model the reason of the refusal. Exit code 1 where one is named in fewer trials than asked for.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from calibration.board.board import Board
from calibration.board.detect import find_corners
from calibration.diagnosis.rules import baseline_m
from calibration.diagnosis.verdicts import judge_fit, judge_refused
from calibration.errors import Degenerate
from calibration.rig_fit.fit import fit_rig
from calibration.views import BoardPose, View
from rig.batch.case import Case
from sim_backend.scenes.board import BoardAtPose
from tests.campaigns.calibration.asked import NAMED, Figure, exit_code
from tests.campaigns.calibration.board_capture import HOT_PER_S, Stand, SweepAsked, set_up, take_sweeps
from tests.campaigns.calibration.rigs import CALIBRATED, OTHER_SPEED, room_picture, view_of
from tests.campaigns.studies import add_options, results_of
from tests.reference.boards.random_rigs import BOARD, random_pose, random_poses, random_rig

POSES = 8
FAR_BOARD = Board("chessboard", (8, 6), 0.08)
"""Found where markers are too small to be read."""
BOTH_WAYS = tuple(SweepAsked(CALIBRATED, direction) for direction in (1, -1))
TWO_SPEEDS = (*BOTH_WAYS, *(SweepAsked(OTHER_SPEED, direction) for direction in (1, -1)))
PASSED = "passed"


@dataclass(frozen=True, slots=True)
class Session:
    """A rig and a person with a board. rng: of all that is random."""

    stand: Stand
    rng: np.random.Generator

    def views(
        self, poses: Sequence[BoardPose], board: Board = BOARD, sweeps: Sequence[SweepAsked] = BOTH_WAYS
    ) -> list[View]:
        """The board at several poses, at two speeds at the first one."""
        views = []
        for i, pose in enumerate(poses):
            speeds = TWO_SPEEDS if i == 0 and sweeps is BOTH_WAYS else sweeps
            taken = take_sweeps(self.stand, [BoardAtPose(board, pose)], speeds, self.rng)
            views.append(view_of(f"{i:03d}", self.stand, taken, board))
        return views

    def pose(self, **how: object) -> BoardPose:
        """A random one."""
        return random_pose(self.rng, self.stand.rig.model.camera, BOARD, **how)

    def distance_m(self, board: Board, seen_px: tuple[float, float]) -> tuple[float, float]:
        """Between which distances the board's width is seen at these sizes in pixels."""
        focal = float(self.stand.rig.model.camera.matrix[0, 0])
        return focal * board.size_m[0] / seen_px[1], focal * board.size_m[0] / seen_px[0]

    def named(self, views: Sequence[View], board: Board = BOARD, stated_baseline_m: float | None = None) -> str:
        """The reason that the verdict on these views names first."""
        camera = self.stand.rig.model.camera
        size = (camera.width, camera.height)
        try:
            fit = fit_rig(views, board, size)
        except Degenerate as refused:
            return judge_refused(refused, views, board, size).codes[0]
        verdict = judge_fit(fit, views, stated_baseline_m=stated_baseline_m).verdict
        return PASSED if verdict.passed else verdict.codes[0]

    def refused(self, shown: Sequence[BoardAtPose]) -> str:
        """The reason why there are no corners in a view of these boards."""
        picture = room_picture(self.stand, take_sweeps(self.stand, shown, BOTH_WAYS, self.rng))
        try:
            find_corners(picture, BOARD, self.stand.dark_per_s > HOT_PER_S)
        except Degenerate as refused:
            return refused.reason
        return PASSED


def few_poses(session: Session, good: list[View]) -> str:
    """Two to five of the good ones."""
    return session.named(good[: int(session.rng.integers(2, 6))])


def one_pose(session: Session, good: list[View]) -> str:
    """One of the good ones; the verdict's word for it is too few."""
    return session.named(good[:1])


def no_tilt(session: Session, good: list[View]) -> str:
    """The board square to the camera within a few degrees, here and there, near and far."""
    poses = [session.pose(cell=int(session.rng.integers(16)), tilt_rad=np.deg2rad(3)) for _ in range(POSES)]
    return session.named(session.views(poses))


def coplanar(session: Session, good: list[View]) -> str:
    """A board that slides on a wall; the verdict's word for it is no tilt."""
    first = session.pose(cell=5, distance_m=session.distance_m(BOARD, (170, 200)), tilt_rad=0.3)
    turned = first.matrix
    steps = session.rng.uniform(-0.15, 0.15, (6, 2))
    poses = [replace(first, position_m=first.position_m + turned[:, :2] @ step) for step in steps]
    return session.named(session.views(poses))


def too_far(session: Session, good: list[View]) -> str:
    """A board so far away that it is 45 to 60 pixels wide."""
    away = session.distance_m(FAR_BOARD, (45, 60))
    poses = [session.pose(cell=int(session.rng.integers(16)), distance_m=away) for _ in range(POSES)]
    return session.named(session.views(poses, FAR_BOARD), FAR_BOARD)


def in_the_middle(session: Session, good: list[View]) -> str:
    """All poses in the middle of the picture."""
    away = session.distance_m(BOARD, (170, 200))
    poses: list[BoardPose] = []
    while len(poses) < POSES:
        pose = session.pose(cell=5, distance_m=away)
        x, y = session.stand.rig.model.camera.project(pose.to_camera(np.array([*BOARD.size_m, 0]) / 2))
        if abs(x / 256 - 1) < 0.12 and abs(y / 256 - 1) < 0.12:
            poses.append(pose)
    return session.named(session.views(poses))


def room_light(session: Session, good: list[View]) -> str:
    """3 to 20 klux, a bright window to full daylight."""
    lux = float(np.exp(session.rng.uniform(np.log(3e3), np.log(2e4))))
    bright = replace(session, stand=replace(session.stand, rig=replace(session.stand.rig, illuminance_lux=lux)))
    return bright.named(bright.views(random_poses(session.rng, session.stand.rig.model.camera, BOARD, POSES)))


def wrong_square(session: Session, good: list[View]) -> str:
    """A print 2 to 5 % larger or smaller than stated; somebody has measured the baseline to a millimetre."""
    scale = 1 + session.rng.choice([-1, 1]) * session.rng.uniform(0.02, 0.05)
    stated = replace(BOARD, square_m=scale * BOARD.square_m, marker_m=scale * BOARD.marker_m)
    return session.named(good, stated, round(baseline_m(session.stand.rig.model.scanner), 3))


def not_locked(session: Session, good: list[View]) -> str:
    """Frames drift against the mirror by half a column to three, to and fro, on every sweep as it comes."""
    wave = float(session.rng.uniform(0.5, 3.0))
    poses = random_poses(session.rng, session.stand.rig.model.camera, BOARD, POSES)
    return session.named(session.views(poses, sweeps=[replace(sweep, phase_wave=wave) for sweep in BOTH_WAYS]))


def moved(session: Session, good: list[View]) -> str:
    """Somebody knocks the scanner in the middle: 2 to 5 mm or 0.3 to 1 degree from some view on."""
    rng, model = session.rng, session.stand.rig.model
    scanner = model.scanner
    if rng.random() < 0.5:
        across = np.cross(scanner.axis_direction, rng.normal(size=3))
        shift = rng.uniform(2e-3, 5e-3) * across / np.linalg.norm(across)
        knocked = replace(scanner, axis_point_m=scanner.axis_point_m + shift)
    else:
        about = rng.normal(size=3)
        turn, _ = cv2.Rodrigues(np.deg2rad(rng.uniform(0.3, 1.0)) * about / np.linalg.norm(about))
        knocked = replace(scanner, axis_direction=turn @ scanner.axis_direction, zero_normal=turn @ scanner.zero_normal)
    after = int(rng.integers(3, len(good) - 2))
    other = replace(session.stand.rig, model=replace(model, scanner=knocked))
    poses = random_poses(rng, model.camera, BOARD, len(good) - after)
    late = replace(session, stand=replace(session.stand, rig=other)).views(poses)
    return session.named([*good[:after], *(replace(view, name=f"late {view.name}") for view in late)])


def no_board(session: Session, good: list[View]) -> str:
    """Something else is held up: a board that is all white paper, its back."""
    pose = session.pose()
    turned = cv2.Rodrigues(pose.matrix @ np.diag([-1.0, 1.0, -1.0]))[0]
    back = BoardPose(np.asarray(turned, np.float64).ravel(), pose.position_m)
    return session.refused([BoardAtPose(BOARD, back)])


def half_out(session: Session, good: list[View]) -> str:
    """Less than half of the board is in the picture."""
    camera = session.stand.rig.model.camera
    pose = session.pose(cell=int(session.rng.choice([5, 6, 9, 10])))
    direction = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)][int(session.rng.integers(4))])
    wanted = session.rng.uniform(0.15, 0.45)
    seen = 1.0
    while seen > wanted:
        pose = replace(pose, position_m=pose.position_m + 0.01 * direction)
        x, y = camera.project(pose.to_camera(BOARD.corners_m))
        seen = float(np.mean((x > 3) & (x < camera.width - 4) & (y > 3) & (y < camera.height - 4)))
    return session.refused([BoardAtPose(BOARD, pose)])


def mirrored(session: Session, good: list[View]) -> str:
    """A print the wrong way round."""
    return session.refused([BoardAtPose(BOARD, session.pose(cell=int(session.rng.integers(16))), mirrored=True)])


def two_boards(session: Session, good: list[View]) -> str:
    """One print twice, side by side."""
    away = session.distance_m(BOARD, (170, 200))
    sides = [session.pose(cell=cell, distance_m=away, tilt_rad=0.2) for cell in (4, 11)]
    return session.refused([BoardAtPose(BOARD, pose) for pose in sides])


def another_board(session: Session, good: list[View]) -> str:
    """A print of the same markers with more or fewer squares across or down."""
    squares = [(9, 6), (7, 6), (10, 7), (6, 4), (6, 8), (8, 5), (8, 8)][int(session.rng.integers(7))]
    other = replace(BOARD, squares=squares)
    pose = random_pose(session.rng, session.stand.rig.model.camera, other, cell=int(session.rng.integers(16)))
    return session.refused([BoardAtPose(other, pose)])


def no_mistake(session: Session, good: list[View]) -> str:
    """A calibration as it should be."""
    return session.named(good, stated_baseline_m=round(baseline_m(session.stand.rig.model.scanner), 3))


MISTAKES: dict[Callable[[Session, list[View]], str], str] = {
    no_mistake: PASSED,
    few_poses: "too-few-poses",
    one_pose: "too-few-poses",
    no_tilt: "no-tilt",
    coplanar: "no-tilt",
    too_far: "board-too-far",
    in_the_middle: "poor-coverage",
    room_light: "room-light",
    wrong_square: "wrong-square-size",
    not_locked: "exposure-not-locked",
    moved: "moved-rig",
    no_board: "no-board",
    half_out: "board-half-out",
    mirrored: "mirrored",
    two_boards: "two-boards",
    another_board: "wrong-board",
}
"""Mistakes, each with the word that the verdict should name it by."""
OF_ONE_VIEW = (no_board, half_out, mirrored, two_boards, another_board)
"""Those that need no good views."""


def trial(seed: int, only: Sequence[str]) -> dict[str, str]:
    """Names that every mistake got with one random rig."""
    begin = Session(set_up(random_rig(np.random.default_rng(seed))), np.random.default_rng([seed, 0]))
    made = [mistake for mistake in MISTAKES if not only or mistake.__name__ in only]
    good: list[View] = []
    if not set(made) <= set(OF_ONE_VIEW):
        good = begin.views(random_poses(begin.rng, begin.stand.rig.model.camera, BOARD, POSES))
    said = {}
    for number, mistake in enumerate(made, start=1):
        said[mistake.__name__] = mistake(replace(begin, rng=np.random.default_rng([seed, number])), good)
    return said


def figures(table: Mapping[str, Counter[str]]) -> list[Figure]:
    """Figures beside what is asked for. table: how often each mistake that was made was called what."""
    names = {mistake.__name__: wanted for mistake, wanted in MISTAKES.items()}
    return [
        Figure(f"share of trials in which {name} is '{names[name]}'", codes[names[name]] / codes.total(), NAMED)
        for name, codes in table.items()
    ]


def main() -> int:
    """Run the campaign; 1 where a mistake is named too rarely."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=30)
    parser.add_argument("--first", type=int, default=1, help="seed of the first rig")
    add_options(parser)
    parser.add_argument("--only", nargs="*", default=[], help="mistakes to make, by name")
    asked = parser.parse_args()
    table: dict[str, Counter[str]] = defaultdict(Counter)
    seeds = range(asked.first, asked.first + asked.trials)
    cases = [
        Case("tests.campaigns.calibration.mistakes:trial", {"seed": seed, "only": asked.only}, {"seed": seed})
        for seed in seeds
    ]
    for seed, said in zip(seeds, results_of(cases, asked.workers, asked.out), strict=True):
        if said is None:
            return 1
        del said["measured"]
        print(f"{seed}: " + ", ".join(f"{name} -> {code}" for name, code in said.items()))
        for name, code in said.items():
            table[name][code] += 1
    for mistake, wanted in MISTAKES.items():
        if (codes := table.get(mistake.__name__)) is not None:
            right = codes[wanted] / codes.total()
            others = ", ".join(f"{code} {count}" for code, count in codes.most_common() if code != wanted)
            print(f"{mistake.__name__:14} {wanted:20} {right:6.1%} of {codes.total()}  {others}")
    return exit_code(figures(table))


if __name__ == "__main__":
    sys.exit(main())
