"""The misfit of a fitted rig: views that do not fit, slow misfit, and mirror terms that the data require.

Terms are decided one at a time, and for good unless a view is dropped later. A term that is not in the model is tried
to first order: the equations give the value it would take and its standard deviation. It is added if its value exceeds
SIGNIFICANT_SD standard deviations and the term can be separated from the others. The angle's polynomial grows by one or
two orders, since a symmetric mirror has no even terms. If several terms qualify, the one that lowers chi2 most is added
first. Another term can partly imitate a missing one (a nonlinear angle imitates light that misses the axis), and the
imitation may even have the smaller relative error.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from calibration.model.parameters import AXIS, TIMES
from calibration.rig_fit.noise import Noise, smooth_basis
from calibration.rig_fit.rows import ANGLE_TERMS
from calibration.rig_fit.solve import RigProblem, RigSolution, ViewNormal, scaled_inverse

SIGNIFICANT_SD = 5.0
LEAST_OWN_SHARE = 1e-7
"""Least share of a term's information that must be left when all others are free; less is rounding."""


@dataclass(frozen=True, slots=True)
class TermDecision:
    """A decision about a term.

    value, sd: as fitted, or as it would be, in the term's own unit; NaN if unknown. along: name and value of the terms
    that would be added with it. gain: decrease of chi2 with all of them.
    """

    name: str
    kept: bool
    """Whether the term belongs in the model."""
    value: float
    sd: float
    reason: str
    """Why, in words."""
    along: tuple[tuple[str, float], ...] = ()
    gain: float = 0.0


def candidates(free: Sequence[Sequence[str]], row_delay: bool) -> list[tuple[str, ...]]:
    """Sets of terms that could be added next; the last of each is judged. row_delay: whether the row delay may be
    one."""
    names = {name for group in free for name in group}
    order = max(k for k in range(ANGLE_TERMS) if f"angle_{k}" in names)
    tried = [tuple(f"angle_{k}" for k in range(order + 1, top + 1)) for top in range(order + 1, order + 3)]
    tried = [terms for terms in tried if int(terms[-1][-1]) < ANGLE_TERMS]
    tried += [(name,) for name in ("offset_0", "cone", "bow") if name not in names]
    if "offset_0" in names and "offset_1" not in names:
        tried.append(("offset_1",))
    if row_delay and "row_delay" not in names:
        tried.append(("row_delay",))
    return tried


def tried(
    problem: RigProblem, solution: RigSolution, new: Sequence[str], left_over: Callable[[float], float]
) -> TermDecision:
    """The decision on the last of the new terms, with all of them free.

    left_over: gives the factor on the variances that would remain if chi2 fell by its argument.
    """
    at = problem.terms.at(new)
    left, wanted = _beside_free(problem, solution, solution, at)
    weight = np.diag(solution.matrix)[at]
    share = np.linalg.eigvalsh(left / np.sqrt(np.outer(weight, weight)))[0] if np.all(weight > 0) else 0.0
    if not share > LEAST_OWN_SHARE:
        return TermDecision(new[-1], False, np.nan, np.nan, "cannot be told from the other terms")
    spread = np.linalg.inv(left)
    values = (spread @ wanted).tolist()
    value, gain = values[-1], float(wanted @ spread @ wanted)
    sd = float(np.sqrt(left_over(gain) * spread[-1, -1]))
    kept = abs(value) > SIGNIFICANT_SD * sd
    said = f"{abs(value) / sd:.1f} sd from 0, limit {SIGNIFICANT_SD:g}"
    return TermDecision(new[-1], kept, value, sd, said, tuple(zip(new[:-1], values[:-1], strict=True)), gain)


def _beside_free(
    problem: RigProblem, solution: RigSolution, own: RigSolution | ViewNormal, at: list[int]
) -> tuple[Array, Array]:
    """(matrix, right) of the equations `own` for the parameters `at`, after elimination of the free parameters."""
    tie = problem.tie
    inverse, _ = scaled_inverse(tie.T @ solution.matrix @ tie)
    across = tie.T @ own.matrix[:, at]
    left = own.matrix[np.ix_(at, at)] - across.T @ inverse @ across
    return left, own.right[at] - across.T @ inverse @ (tie.T @ solution.right)


def best(decisions: Sequence[TermDecision]) -> int | None:
    """Index of the decision with the largest gain among those that would be kept; None if there is none."""
    kept = [at for at, decision in enumerate(decisions) if decision.kept]
    return max(kept, key=lambda at: decisions[at].gain) if kept else None


def lag_decisions(
    solution: RigSolution, problem: RigProblem, free: Sequence[Sequence[str]], timing: Array, determined: bool
) -> list[TermDecision]:
    """The decisions on the lags that are still free: one for each lag, or one for both if they share a value.

    timing: (3,), both lags and the row delay in seconds. determined: whether the sweeps' directions and speeds
    determine the lags. If not, one more decision says that the lag was not fitted and keeps its value; its sd is NaN.
    """
    spread = np.sqrt(np.diag(solution.covariance(problem.tie)))
    decisions = []
    for group in (group for group in free if group[0].startswith("lag")):
        at = problem.terms.at(group[:1])[0]
        said = "of each direction" if len(group) == 1 else "one for both: the sweeps do not tell them apart"
        value = float(timing[TIMES.index(group[0])])
        decisions.append(TermDecision("/".join(group), True, value, float(spread[at]), said))
    if not determined:
        value = float(timing[0])
        decisions.append(TermDecision("lag", False, value, np.nan, "not told by one direction at one speed: as it was"))
    return decisions


def first_order(problem: RigProblem, solution: RigSolution, open_one: TermDecision) -> Array:
    """(p,) change of all shared parameters if the term of `open_one`, and those in its `along`, were added."""
    taken = dict((*open_one.along, (open_one.name, open_one.value)))
    at, values = problem.terms.at(tuple(taken)), np.array(list(taken.values()))
    inverse, _ = scaled_inverse(problem.tie.T @ solution.matrix @ problem.tie)
    change: Array = -problem.tie @ (inverse @ (problem.tie.T @ (solution.matrix[:, at] @ values)))
    change[at] = values
    return change


def corner_noise(problem: RigProblem, solution: RigSolution, noise: Noise) -> float:
    """Corner sd (pixels) from the corners alone. Passages that contradict the corners would make the corners seem
    noisy."""
    p = len(problem.terms.names)
    shared: Array = np.zeros((p, p))
    right: Array = np.zeros(p)
    chi2, count = 0.0, 0.0
    for view, (rows, _), counts in zip(solution.views, solution.rows, problem.counted, strict=True):
        if not counts:
            continue
        own, pose_right = view.corner_part[p:, p:], view.corner_right[p:]
        across = np.linalg.solve(own, np.hstack([view.corner_part[p:, :p], pose_right[:, None]]))
        shared += view.corner_part[:p, :p] - view.corner_part[:p, p:] @ across[:, :-1]
        right += view.corner_right[:p] - view.corner_part[:p, p:] @ across[:, -1]
        chi2 += view.chi2[0] - float(pose_right @ across[:, -1])
        count += rows.residual.size - 6
    tie = problem.tie[:, np.any(problem.tie[: len(problem.terms.camera)] != 0, axis=0)]
    if tie.shape[1]:
        told = tie.T @ right
        chi2 -= float(told @ np.linalg.lstsq(tie.T @ shared @ tie, told, rcond=1e-12)[0])
    return noise.corner_sd_px * float(np.sqrt(max(chi2, 0.0) / max(count - tie.shape[1], 1.0)))


SCANNER_MOVES = (*AXIS, "angle_0")
"""Parameters of the scanner's place, which a knock changes: five of six, as a shift along the axis changes nothing."""
ODD_CHI2 = 60.0
"""Least fall of chi2 if an odd view gets a scanner place of its own. Chance alone gives 20 once in a thousand views."""
ODD_TIMES = 8.0
"""Least such fall as a multiple of the other views' median, in case the model fits none of the views well."""
EXPLAINED_SHARE = 0.05
"""A view is odd too if its own place of the scanner leaves at most this share of the misfit, and OTHERS_SHARE and
LEAST_EXPLAINED hold as well."""
OTHERS_SHARE = 0.3
"""Least share of the misfit that must be left if any other view has its own place of the scanner instead."""
LEAST_EXPLAINED = 2.0
"""Least misfit, as a factor on the variances, at which EXPLAINED_SHARE and OTHERS_SHARE are applied."""
FEWEST_TO_TELL = 4
"""Fewest views with passages among which one can be odd."""
UNDECIDED_SD = 2.5
"""Significance from which on a term that was not added widens the covariance by the change that it would cause."""
MISFIT_SD = 3.0
"""Sds by which chi2 of the corners, or of slow variations, must exceed its mean before it is believed."""


def odd_view(problem: RigProblem, solution: RigSolution, left: "Misfit") -> int | None:
    """Index of the view that gains most from a scanner place of its own, if it stands out, else None. left: the misfit.

    Each view's equations tell how far chi2 would fall if the scanner had another place for this view alone. Views
    without passages are left out: their fall is always zero, and any other view would stand out from them. With few
    views, one that does not fit bends the fit so far that the others seem to need another place too; but only another
    place for the view that does not fit removes the misfit.
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
    """Whether one view's own place of the scanner explains the misfit, and no other view's does."""
    excess = left.without(0.0) - 1
    remains, otherwise = left.without(gain) - 1, left.without(next_gain) - 1
    return excess >= LEAST_EXPLAINED - 1 and remains <= EXPLAINED_SHARE * excess and otherwise >= OTHERS_SHARE * excess


def with_passages(problem: RigProblem) -> NDArray[np.bool_]:
    """(views,) True if the line was seen on the board."""
    return np.array([seen.command.size > 0 for seen in problem.sightings])


def _own_place(problem: RigProblem, solution: RigSolution, view: int) -> float:
    """Fall of chi2, to first order, when the view has its own place of the scanner."""
    at, own = problem.terms.at(SCANNER_MOVES), solution.views[view]
    left, wanted = _beside_free(problem, solution, own, at)
    scale = 1 / np.sqrt(np.maximum(np.diag(own.matrix)[at], 1e-300))
    values, vectors = np.linalg.eigh(left * scale[:, None] * scale)
    told = values > 1e-6
    along = vectors[:, told].T @ (scale * wanted)
    return float(np.sum(along**2 / values[told]))


def widening(problem: RigProblem, solution: RigSolution, decisions: Sequence[TermDecision]) -> Array:
    """(p, p) to add to the covariance, for the effect of the term that came nearest to being added; may be 0."""
    wider: Array = np.zeros_like(solution.matrix)
    open_ones = [d for d in decisions if not d.kept and np.isfinite(d.sd) and abs(d.value) > UNDECIDED_SD * d.sd]
    if open_ones:
        nearest = max(open_ones, key=lambda d: abs(d.value) / d.sd)
        change = first_order(problem, solution, nearest)
        wider = np.outer(change, change)
    return wider


class Misfit(NamedTuple):
    """(chi2, chi2 expected from noise) of the corners and of slow variations over the sweeps."""

    corners: tuple[float, float]
    slow: tuple[float, float]

    @property
    def factor(self) -> float:
        """Factor by which variances are larger than expected from noise; 1 if that may be chance."""
        found = [1.0]
        for chi2, free in self:
            if free >= 1 and chi2 > free + MISFIT_SD * np.sqrt(2 * free):
                found.append(chi2 / free)
        return max(found)

    def without(self, gain: float) -> float:
        """1 plus the excess of both chi2 that would remain if chi2 fell by `gain`, divided by the degrees of freedom of
        `slow`. Unlike `factor` it adds both parts and tests no significance."""
        excess = sum(max(chi2 - free, 0.0) for chi2, free in self)
        return max(1.0, 1 + (excess - gain) / max(self.slow[1], 1.0))


def of_fit(problem: RigProblem, solution: RigSolution) -> Misfit:
    """The misfit: contradictions of corners and passages with each other, and of passages among themselves."""
    covariance = solution.covariance(problem.tie)
    corner_chi2 = corner_free = slow_chi2 = slow_free = taken = 0.0
    for view, own in enumerate(solution.views):
        if problem.counted[view]:
            joint = own.joint(covariance)
            corner_chi2 += own.chi2[0]  # with the noise estimated from the corners alone
            corner_free += solution.rows[view][0].residual.size - float(np.sum(joint * own.corner_part))
            for chi2, count in _of_sweeps(problem, solution, view):
                slow_chi2, slow_free = slow_chi2 + chi2, slow_free + count
            taken += float(np.sum(joint * own.passage_part))  # parameters that the passages determine, not the corners
    return Misfit((corner_chi2, corner_free), (slow_chi2, slow_free - taken))


def _of_sweeps(problem: RigProblem, solution: RigSolution, view: int) -> Iterator[tuple[float, int]]:
    """For each sweep of a view, chi2 of the smooth part of its residuals, and the number of terms of that part."""
    seen, jitter, residual = problem.sightings[view], solution.jitter, solution.rows[view][1].residual
    _, weight, starts = solution.weight[view]
    for sweep in seen.sweeps:
        basis = smooth_basis(seen.command[sweep], seen.y_px[sweep])
        inside = starts[(starts >= sweep.start) & (starts < sweep.stop)] - sweep.start
        whole = np.hstack([basis, residual[sweep, None]]) * weight[sweep, None]
        products = basis.T @ whole
        if jitter:
            sums = np.add.reduceat(whole, inside)
            share = jitter / (1 + jitter * np.add.reduceat(weight[sweep], inside))
            products = products - (sums[:, :-1] * share[:, None]).T @ sums
        chi2 = products[:, -1] @ np.linalg.lstsq(products[:, :-1], products[:, -1], rcond=1e-9)[0]
        yield float(chi2), basis.shape[1]
