"""Which terms of the mirror the data call for, decided one at a time, each decision kept.

A term that is not in the model is tried to first order: the equations say what value it would take and how sure that
would be. It comes in where it would be SIGNIFICANT_SD of its own standard deviations and can be told from the others.
The angle's polynomial grows by one order or two, since a symmetric mirror has no even terms. Of several that would come
in the first is the one that leaves least unexplained: what is not there can stand for a part of what is, as light that
passes the axis for an angle that bends, and be surer of its value than what it stands for.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.model.parameters import TIMES
from calibration.rig_fit.noise import Noise
from calibration.rig_fit.rows import ANGLE_TERMS
from calibration.rig_fit.solve import Problem, Solution, scaled_inverse

Array = NDArray[np.float64]

SIGNIFICANT_SD = 5.0
LEAST_OWN_SHARE = 1e-7
"""Of a term's weight in the equations, what is its own when all others are free; less is rounding."""


@dataclass(frozen=True, slots=True)
class Decision:
    """One about a term. value, sd: what it is or would be, in its own unit; NaN where nothing tells. along: name and
    value of the terms that would come in with it. gain: by which chi2 would fall with all of them."""

    name: str
    kept: bool
    value: float
    sd: float
    reason: str
    along: tuple[tuple[str, float], ...] = ()
    gain: float = 0.0


def with_free(problem: Problem, groups: Sequence[Sequence[str]]) -> Problem:
    """The problem with these parameters free; those of one group have one value."""
    tie = np.zeros((len(problem.terms.names), len(groups)))
    for column, group in enumerate(groups):
        tie[problem.terms.at(group), column] = 1.0
    return replace(problem, tie=tie)


def candidates(free: Sequence[Sequence[str]], row_delay: bool) -> list[tuple[str, ...]]:
    """What could come in next: (new terms), of which the last is the one that is judged."""
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


def tried(problem: Problem, solution: Solution, new: Sequence[str], left_over: Callable[[float], float]) -> Decision:
    """What the last of the new terms would be with all of them free.

    left_over: by which factor variances would still be too large, were chi2 less by so much.
    """
    at = problem.terms.at(new)
    matrix, right = solution.matrix, solution.right
    tie = problem.tie
    inverse, _ = scaled_inverse(tie.T @ matrix @ tie)
    across = tie.T @ matrix[:, at]
    own = matrix[np.ix_(at, at)]
    left = own - across.T @ inverse @ across
    wanted = right[at] - across.T @ inverse @ (tie.T @ right)
    weight = np.diag(own)
    share = np.linalg.eigvalsh(left / np.sqrt(np.outer(weight, weight)))[0] if np.all(weight > 0) else 0.0
    if not share > LEAST_OWN_SHARE:
        return Decision(new[-1], False, np.nan, np.nan, "cannot be told from the other terms")
    spread = np.linalg.inv(left)
    values = (spread @ wanted).tolist()
    value, gain = values[-1], float(wanted @ spread @ wanted)
    sd = float(np.sqrt(left_over(gain) * spread[-1, -1]))
    kept = abs(value) > SIGNIFICANT_SD * sd
    said = f"{abs(value) / sd:.1f} sd from 0, limit {SIGNIFICANT_SD:g}"
    return Decision(new[-1], kept, value, sd, said, tuple(zip(new[:-1], values[:-1], strict=True)), gain)


def best(decisions: Sequence[Decision]) -> int | None:
    """Of those that would be kept the one that leaves least unexplained."""
    kept = [at for at, decision in enumerate(decisions) if decision.kept]
    return max(kept, key=lambda at: decisions[at].gain) if kept else None


def lag_decisions(solution: Solution, problem: Problem, free: Sequence[Sequence[str]], timing: Array) -> list[Decision]:
    """What the directions and speeds told of the lags."""
    spread = np.sqrt(np.diag(solution.covariance(problem.tie)))
    told = {group[0]: group for group in free if group[0].startswith("lag")}
    decisions = []
    for group in told.values():
        at = problem.terms.at(group[:1])[0]
        said = "of each direction" if len(group) == 1 else "one for both: the sweeps do not tell them apart"
        value = float(timing[TIMES.index(group[0])])
        decisions.append(Decision("/".join(group), True, value, float(spread[at]), said))
    if not told:
        value = float(timing[0])
        decisions.append(Decision("lag", False, value, np.nan, "not told by one direction at one speed: as it was"))
    return decisions


def first_order(problem: Problem, solution: Solution, open_one: Decision) -> Array:
    """(p,) by how much all shared parameters would change, were this term taken in, and those that go along."""
    taken = dict((*open_one.along, (open_one.name, open_one.value)))
    at, values = problem.terms.at(tuple(taken)), np.array(list(taken.values()))
    inverse, _ = scaled_inverse(problem.tie.T @ solution.matrix @ problem.tie)
    change: Array = -problem.tie @ (inverse @ (problem.tie.T @ (solution.matrix[:, at] @ values)))
    change[at] = values
    return change


def corner_noise(problem: Problem, solution: Solution, noise: Noise) -> float:
    """Corner sd (pixels) that is left when the corners alone decide about camera and poses.

    With the passages in, corners that contradict them, as after a knock on the rig, would only pass for noisy ones.
    """
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
