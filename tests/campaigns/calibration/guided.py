"""Guided sessions of a second simulator: does a pose bring what the guide forecasts?

    python -m tests.campaigns.calibration.guided --sessions 20 [--first 0] [--workers 2]

Random rigs show three poses that begin well, then those that the guide asks for, at three speeds by turns. After each
the depth error that its verdict expects is compared with what was forecast before it was shown. To save time the guide
chooses among 48 random ones of its poses. Some 20 s CPU a session.
"""

import argparse
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from calibration.diagnosis.verdicts import judge_fit
from calibration.errors import CalibrationError
from calibration.guide import Forecast, candidates, next_pose, rough_camera, sequence
from calibration.rig_fit.fit import RigFit, fit_rig
from calibration.views import View
from rig.batch.case import Case
from tests.campaigns.studies import add_options, results_of
from tests.reference.boards.calibration_data import BOARD, TrueRig, ViewErrors, random_rig, seen_view

AT_M = 5.0
DEPTH_RANGE_M = (0.5, 4.0)
START, MOST = 3, 9
"""Poses before there is a forecast, and in all."""
CHOICES = 48
SPEEDS = (1.0, 1 / 0.3, 0.5)
"""Speeds at which `rig calibrate planes` sweeps by turns, in units of the config's."""


class Step(NamedTuple):
    """Views shown, the expected error that was forecast for them and that which came, metres."""

    views: int
    forecast_m: float
    expected_m: float


def session(seed: int) -> Iterator[Step]:
    """One rig, shown pose by pose; no step from where there is no fit."""
    rng = np.random.default_rng(seed)
    rig = random_rig(rng)
    size = (rig.width, rig.height)
    seen = ViewErrors(
        jitter=float(rng.choice([0, 2e-5, 5e-5, 1e-4, 2e-4])),
        corner_px=rng.uniform(0.02, 0.1),
        passage=10 ** rng.uniform(-3.5, -2.7),
        factor=float(rng.choice([1, 1.3])),
        passages=600,
    )
    speed = float(rng.choice([35.2, 88.0, 352.0]))
    begin = sequence(candidates(rough_camera(size), BOARD, DEPTH_RANGE_M), MOST)
    views: list[View] = []
    forecast_m = np.nan
    while len(views) <= MOST:
        fit = _fitted(views, rig) if len(views) >= START else None
        if fit is None:
            pose, forecast_m = begin[len(views) % MOST].pose, np.nan
        else:
            expected_m = judge_fit(fit, views, at_m=AT_M).evidence.expected_m
            if np.isfinite(forecast_m):
                yield Step(len(views), forecast_m, expected_m)
            choices = rng.permutation(np.array(candidates(fit.model.camera, BOARD, DEPTH_RANGE_M), object))[:CHOICES]
            advice = next_pose(list(choices), AT_M, expected_m, Forecast(fit, AT_M))
            pose, forecast_m = advice.candidate.pose, advice.after_m
        swept = speed * SPEEDS[len(views) % len(SPEEDS)]
        views.append(seen_view(rng, rig, pose.rotation, pose.position_m, seen, (swept, -swept), f"{len(views):03d}"))


def one_session(seed: int) -> dict[str, Any]:
    """The steps of one session, as a case."""
    return {"steps": list(session(seed))}


def _fitted(views: list[View], rig: TrueRig) -> RigFit | None:
    try:
        return fit_rig(views, BOARD, (rig.width, rig.height))
    except CalibrationError:
        return None


def main() -> None:
    """Run the sessions, print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    add_options(parser)
    asked = parser.parse_args()
    steps: list[Step] = []
    seeds = range(asked.first, asked.first + asked.sessions)
    cases = [Case("tests.campaigns.calibration.guided:one_session", {"seed": seed}, {"seed": seed}) for seed in seeds]
    for seed, result in zip(seeds, results_of(cases, asked.workers, asked.out), strict=True):
        found = [] if result is None else [Step(*step) for step in result["steps"]]  # one that failed has been told
        said = ", ".join(f"{1e3 * step.forecast_m:.2f}/{1e3 * step.expected_m:.2f}" for step in found)
        print(f"{seed}: forecast/expected {said} mm", flush=True)
        steps += found
    for views in sorted({step.views for step in steps}):
        print(f"after {views} views: {_spread([step for step in steps if step.views == views])}")
    print(f"all {len(steps)} steps: {_spread(steps)}")


def _spread(steps: list[Step]) -> str:
    ratio = np.array([step.forecast_m / step.expected_m for step in steps])
    low, middle, high = np.percentile(ratio, [10, 50, 90])
    return f"forecast over what came {middle:.2f} (10 % {low:.2f}, 90 % {high:.2f})"


if __name__ == "__main__":
    main()
