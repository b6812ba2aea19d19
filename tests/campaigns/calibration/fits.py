"""Random rigs fitted from views of a second simulator: is the depth error what the covariance says?

    python -m tests.campaigns.calibration.fits --rigs 200 [--first 0]

Prints, for depths at 5 m, the ratio of actual to predicted errors (median over the rigs) and the share of the stated
95 % intervals that hold the truth; exit code 1 where these are not what is asked for. 200 rigs take some 8 minutes of
one core.
"""

import argparse
import sys
from typing import Any

import numpy as np

from calibration.errors import CalibrationError
from calibration.rig_fit.fit import RigFit, fit_rig
from calibration.views import MAD_TO_SD
from rig.batch.case import Case
from tests.campaigns.calibration.asked import INSIDE, RATIO, Figure, exit_code
from tests.campaigns.studies import add_options, results_of
from tests.reference.boards.calibration_data import BOARD, ViewErrors, depth_errors, random_rig, random_views

AT_M = 5.0
FIGURES = "actual", "stated", "inside", "square"
"""Figures of a rig, see `one_fit`."""


def one_rig(seed: int, passages: int = 600) -> tuple[RigFit, np.ndarray, np.ndarray]:
    """(fit, depth errors, their stated sd) of a random rig, noise, speed and sequence of poses."""
    rng = np.random.default_rng(seed)
    rig = random_rig(rng)
    seen = ViewErrors(
        jitter=float(rng.choice([0, 2e-5, 5e-5, 1e-4, 2e-4])),
        corner_px=rng.uniform(0.02, 0.1),
        passage=10 ** rng.uniform(-3.5, -2.7),
        factor=float(rng.choice([1, 1.3])),
        outliers=float(rng.choice([0, 0.01])),
        passages=passages,
    )
    speed = float(rng.choice([35.2, 88.0, 352.0]))
    views = random_views(rng, rig, int(rng.integers(10, 16)), seen, (speed, -speed))
    fit = fit_rig(views, BOARD, (rig.width, rig.height))
    return fit, *depth_errors(fit.model, rig, AT_M, speed, seed)


def one_fit(seed: int) -> dict[str, Any]:
    """A rig as a case: medians of the actual and the stated error in metres, share inside, mean square and a line."""
    try:
        fit, error, sd = one_rig(seed)
    except CalibrationError as problem:
        return {"refused": str(problem)}
    actual, stated = float(np.median(np.abs(error))), float(np.median(sd)) / MAD_TO_SD
    square = float(np.mean((error / sd) ** 2))
    kept = ", ".join(decision.name for decision in fit.decisions if decision.kept)
    said = (
        f"error {1e3 * actual:.2f} mm, predicted {1e3 * stated:.2f} mm, normalised {np.sqrt(square):.2f}, "
        f"misfit {fit.misfit:.2f}, {kept}, outliers {fit.outliers}"
    )
    inside = float(np.mean(np.abs(error) < 1.96 * sd))
    return {"actual": actual, "stated": stated, "inside": inside, "square": square, "said": said}


def main() -> int:
    """Fit, compare, print; 1 where the figures are not what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rigs", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    add_options(parser)
    asked = parser.parse_args()
    seeds = range(asked.first, asked.first + asked.rigs)
    cases = [Case("tests.campaigns.calibration.fits:one_fit", {"seed": seed}, {"seed": seed}) for seed in seeds]
    results = results_of(cases, asked.workers, asked.out)
    fits = {seed: found for seed, found in zip(seeds, results, strict=True) if found is not None}
    refused = [f"{seed}: {found['refused']}" for seed, found in fits.items() if "refused" in found]
    done = {seed: found for seed, found in fits.items() if "refused" not in found}
    for seed, found in done.items():
        print(f"{seed}: {found['said']}", flush=True)
    actual, stated, inside, squares = ([found[name] for found in done.values()] for name in FIGURES)
    for line in refused:
        print(line)
    if not actual:
        return exit_code(figures(np.array([]), np.array([])))
    ratio = np.array(actual) / np.array(stated)
    print(
        f"{len(actual)} rigs, {len(refused)} refused: actual to predicted error at {AT_M:g} m {np.median(ratio):.3f} "
        f"(median over rigs; normalised rms {np.sqrt(np.mean(squares)):.3f}), 95 % intervals hold the truth in "
        f"{100 * np.mean(inside):.1f} %; medians {1e3 * np.median(actual):.2f} mm, worst {1e3 * np.max(actual):.1f} "
        f"mm; {np.mean([found['measured']['seconds'] for found in done.values()]):.2f} s a rig"
    )
    return max(exit_code(figures(ratio, np.array(inside))), int(None in results))


def figures(ratio: np.ndarray, inside: np.ndarray) -> list[Figure]:
    """Figures beside what is asked for. ratio (rigs,): actual to predicted error; inside: intervals with the truth."""
    none = np.nan
    return [
        Figure("actual to predicted depth error (median of the rigs)", np.median(ratio) if len(ratio) else none, RATIO),
        Figure("share of true depths in the stated 95 % intervals", np.mean(inside) if len(inside) else none, INSIDE),
    ]


if __name__ == "__main__":
    sys.exit(main())
