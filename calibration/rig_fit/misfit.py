"""What a fitted rig does not describe: views that do not belong, slow misfit, terms that are neither there nor not."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.rig_fit.noise import smooth_basis
from calibration.rig_fit.select import Decision, first_order
from calibration.rig_fit.solve import Problem, Solution, scaled_inverse

Array = NDArray[np.float64]

SCANNER_MOVES = ("axis_turn_1", "axis_turn_2", "axis_shift_1", "axis_shift_2", "angle_0")
"""What a scanner that was knocked changes: five of six, since a shift along the axis changes nothing."""
ODD_CHI2 = 60.0
"""By which chi2 must fall when a view has its own place of the scanner: 20 is one in a thousand."""
ODD_TIMES = 8.0
"""And more than so many times what it falls by for most views, should the model fit none of them well."""
EXPLAINED_SHARE = 0.05
"""Or at most this of the misfit is left when the view has its own place of the scanner,"""
OTHERS_SHARE = 0.3
"""and at least this whichever other view had one,"""
LEAST_EXPLAINED = 2.0
"""where there is as much of a misfit as this factor on the variances."""
FEWEST_TO_TELL = 4
"""Views with passages: of fewer none is the usual one."""
UNDECIDED_SD = 2.5
"""From here on a term that was not taken in widens the covariance by what it would change."""
MISFIT_SD = 3.0
"""By which chi2 of the slow misfit must exceed its mean before it is believed."""


def odd_view(problem: Problem, solution: Solution, left: "Misfit") -> int | None:
    """The view that would most like a scanner elsewhere, if it stands out, else None. left: the misfit of the fit.

    Each view's equations say how far chi2 would fall if the scanner had a place of its own for this view alone. Views
    without passages say nothing of it: with their zeros any other would stand out. Where views are few, one that does
    not belong bends the fit so far that all others want the scanner elsewhere too; but only with its own place does
    nothing of the misfit remain.
    """
    counted = np.flatnonzero(problem.counted & with_passages(problem))
    gains = np.array([_own_place(problem, solution, int(view)) for view in counted])
    if len(gains) < FEWEST_TO_TELL:
        return None
    worst = int(np.argmax(gains))
    others = np.delete(gains, worst)
    if gains[worst] <= ODD_CHI2:
        return None
    stands_out = gains[worst] > ODD_TIMES * float(np.median(others))
    return int(counted[worst]) if stands_out or _alone(left, float(gains[worst]), float(others.max())) else None


def _alone(left: "Misfit", gain: float, next_gain: float) -> bool:
    """Whether a view's own place explains the misfit, and no other view's."""
    excess = left.without(0.0) - 1
    remains, otherwise = left.without(gain) - 1, left.without(next_gain) - 1
    return excess >= LEAST_EXPLAINED - 1 and remains <= EXPLAINED_SHARE * excess and otherwise >= OTHERS_SHARE * excess


def with_passages(problem: Problem) -> NDArray[np.bool_]:
    """(views,) True where the line was seen on the board."""
    return np.array([seen.command.size > 0 for seen in problem.sightings])


def _own_place(problem: Problem, solution: Solution, view: int) -> float:
    """Fall of chi2 to first order."""
    at = problem.terms.at(SCANNER_MOVES)
    tie, own = problem.tie, solution.views[view]
    inverse, _ = scaled_inverse(tie.T @ solution.matrix @ tie)
    across = tie.T @ own.matrix[:, at]
    left = own.matrix[np.ix_(at, at)] - across.T @ inverse @ across
    wanted = own.right[at] - across.T @ inverse @ (tie.T @ solution.right)
    scale = 1 / np.sqrt(np.maximum(np.diag(own.matrix)[at], 1e-300))
    values, vectors = np.linalg.eigh(left * scale[:, None] * scale)
    told = values > 1e-6
    along = vectors[:, told].T @ (scale * wanted)
    return float(np.sum(along**2 / values[told]))


def widening(problem: Problem, solution: Solution, decisions: Sequence[Decision]) -> Array:
    """(p, p) to add to the covariance, for the term that came nearest to being taken in: what it would change."""
    wider: Array = np.zeros_like(solution.matrix)
    open_ones = [d for d in decisions if not d.kept and np.isfinite(d.sd) and abs(d.value) > UNDECIDED_SD * d.sd]
    if open_ones:
        nearest = max(open_ones, key=lambda d: abs(d.value) / d.sd)
        change = first_order(problem, solution, nearest)
        wider = np.outer(change, change)
    return wider


class Misfit(NamedTuple):
    """Chi2 and how much of it noise would make: of the corners, and of what varies slowly over the sweeps."""

    corners: tuple[float, float]
    slow: tuple[float, float]

    @property
    def factor(self) -> float:
        """By which variances are larger than the noise makes them; 1 where that may be chance."""
        found = [1.0]
        for chi2, free in self:
            if free >= 1 and chi2 > free + MISFIT_SD * np.sqrt(2 * free):
                found.append(chi2 / free)
        return max(found)

    def without(self, gain: float) -> float:
        """The factor that would be left if chi2 fell by this."""
        excess = sum(max(chi2 - free, 0.0) for chi2, free in self)
        return max(1.0, 1 + (excess - gain) / max(self.slow[1], 1.0))


def misfit(problem: Problem, solution: Solution) -> Misfit:
    """What corners and passages have against each other, and passages among themselves."""
    return Misfit(_of_corners(problem, solution), _of_sweeps(problem, solution))


def _of_corners(problem: Problem, solution: Solution) -> tuple[float, float]:
    """With the noise that the corners alone speak for."""
    covariance = solution.covariance(problem.tie)
    chi2 = free = 0.0
    for view, (rows, _), counts in zip(solution.views, solution.rows, problem.counted, strict=True):
        if counts:
            chi2 += view.chi2[0]
            free += rows.residual.size - float(np.sum(view.joint(covariance) * view.corner_part))
    return chi2, free


def _of_sweeps(problem: Problem, solution: Solution) -> tuple[float, float]:
    """Of the smooth part of what is left of each sweep."""
    chi2, count = 0.0, 0
    jitter = solution.weight.jitter
    for view, seen in enumerate(problem.sightings):
        if not problem.counted[view]:
            continue
        residual, weight = solution.rows[view][1].residual, solution.weight.passages[view]
        starts = solution.weight.starts[view]
        for sweep in seen.sweeps:
            basis = smooth_basis(seen.command[sweep], seen.y_px[sweep])
            inside = starts[(starts >= sweep.start) & (starts < sweep.stop)] - sweep.start
            whole = np.hstack([basis, residual[sweep, None]]) * weight[sweep, None]
            products = basis.T @ whole
            if jitter:
                sums = np.add.reduceat(whole, inside)
                share = jitter / (1 + jitter * np.add.reduceat(weight[sweep], inside))
                products = products - (sums[:, :-1] * share[:, None]).T @ sums
            chi2 += float(products[:, -1] @ np.linalg.lstsq(products[:, :-1], products[:, -1], rcond=1e-9)[0])
            count += basis.shape[1]
    return chi2, count - _taken(problem, solution)


def _taken(problem: Problem, solution: Solution) -> float:
    """How many parameters the passages, rather than the corners, determine."""
    covariance = solution.covariance(problem.tie)
    return float(
        sum(
            np.sum(view.joint(covariance) * view.passage_part)
            for view, counts in zip(solution.views, problem.counted, strict=True)
            if counts
        )
    )
