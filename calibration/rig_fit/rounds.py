"""The rounds of a rig's fit: fit, look at what is left, decide, fit again.

A round ends with one decision at most: a term of the mirror comes in, a lag below 0 is held, a view that does not
belong loses its say. The noise is told anew from the residuals of every round.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from calibration.errors import Degenerate, digits
from calibration.rig_fit.misfit import (
    TermDecision,
    best,
    candidates,
    corner_noise,
    misfit,
    odd_view,
    tried,
    with_free,
    with_passages,
)
from calibration.rig_fit.noise import Noise, passage_noise
from calibration.rig_fit.solve import RigProblem, RigSolution, solved
from calibration.rig_fit.state import RigState, with_terms_of

MOST_ROUNDS = 16
"""Most rounds of fitting and deciding; every round but the last adds a term, drops a view or settles the noise."""
MOST_IDLE_ROUNDS = 4
"""Most rounds without a decision: data that contradict each other may keep a fit from coming to rest for ever."""
SETTLED_SHARE = 0.02
"""Relative change of the noise that is still allowed in the last round."""
MOST_ODD_SHARE = 1 / 3
"""Largest share of the views with passages that may be dropped as outliers; beyond it, it is not they who are wrong."""


@dataclass
class Rounds:
    """The state of fitting and deciding.

    base: parameters that are free to begin with; free: now. decisions: the last ones about terms; kept: those that
    changed the model.
    """

    problem: RigProblem
    base: tuple[tuple[str, ...], ...]
    state: RigState
    noise: Noise
    free: list[tuple[str, ...]] = field(init=False)
    solution: RigSolution | None = None
    decisions: tuple[TermDecision, ...] = ()
    kept: tuple[TermDecision, ...] = ()

    def __post_init__(self) -> None:
        """Begin with the least of all models."""
        self.free = list(self.base)

    def run(self) -> None:
        """Fit and decide until nothing changes."""
        idle = 0
        for _ in range(MOST_ROUNDS):
            self.solution = solved(self.problem, self.state, self.noise, roughly=idle == 0)
            self.state = self.solution.state
            before, self.noise = self.noise, self._noise()
            there = self.solution.converged and idle > 0
            last = idle + 1 == MOST_IDLE_ROUNDS
            if self._with_new_term() or ((there or last) and self._without_negative_lag()) or self._without_odd_view():
                idle = 0
                continue
            idle += 1
            if last or (there and _settled(before, self.noise)):
                return

    def _noise(self) -> Noise:
        assert self.solution is not None
        factor, jitter, reach = passage_noise([rows.residual for _, rows in self.solution.rows], self.problem.sightings)
        return Noise(corner_noise(self.problem, self.solution, self.noise), factor, jitter, reach)

    def _without_odd_view(self) -> bool:
        assert self.solution is not None
        if np.count_nonzero(~self.problem.counted) + 1 > MOST_ODD_SHARE * np.count_nonzero(with_passages(self.problem)):
            return False
        odd = odd_view(self.problem, self.solution, misfit(self.problem, self.solution))
        if odd is None:
            return False
        counted = self.problem.counted.copy()
        counted[odd] = False
        # What it made the fit take in is decided again without it.
        self.free, self.kept = list(self.base), ()
        self.problem = replace(with_free(self.problem, self.free), counted=counted)
        self.state = with_terms_of(self.state, self.base)
        return True

    def _without_negative_lag(self) -> bool:
        assert self.solution is not None
        spread = np.sqrt(np.diag(self.solution.covariance(self.problem.tie)))
        for group in self.free:
            at = self.problem.terms.at(group)[0] - len(self.problem.terms.names)
            if not group[0].startswith("lag") or self.state.timing[at] >= 0:
                continue
            value, sd = float(self.state.timing[at]), float(spread[at])
            if value < -5 * sd:
                raise Degenerate(
                    "negative-lag",
                    f"mirror would run {digits(-value * 1e6)} us +- {digits(sd * 1e6, 2)} us ahead of its command, "
                    "limit 0; check the polarity and the delay of the scan marker",
                )
            timing = self.state.timing.copy()
            timing[[self.problem.terms.at([name])[0] - len(self.problem.terms.names) for name in group]] = 0.0
            self.state = replace(self.state, timing=timing)
            self.free.remove(group)
            self.problem = with_free(self.problem, self.free)
            self.kept += (TermDecision("/".join(group), False, value, sd, "not below 0 for any mirror: held at 0"),)
            return True
        return False

    def _with_new_term(self) -> bool:
        assert self.solution is not None
        timed = any(group[0].startswith("lag") for group in self.free)
        tries = candidates(self.free, row_delay=timed)
        left_over = misfit(self.problem, self.solution).without
        self.decisions = tuple(tried(self.problem, self.solution, new, left_over) for new in tries)
        chosen = best(self.decisions)
        if chosen is None:
            return False
        self.free += [(name,) for name in tries[chosen]]
        self.problem = with_free(self.problem, self.free)
        self.kept += (self.decisions[chosen],)
        return True


def _settled(before: Noise, after: Noise) -> bool:
    def near(a: float, b: float) -> bool:
        return abs(a - b) <= SETTLED_SHARE * max(a, b)

    return near(before.corner_sd_px, after.corner_sd_px) and near(
        np.hypot(before.passage_factor, before.jitter_sd), np.hypot(after.passage_factor, after.jitter_sd)
    )
