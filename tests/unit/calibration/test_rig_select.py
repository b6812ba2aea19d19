"""What a term would change is what changes once it is in; which of several comes in."""

from types import SimpleNamespace

import numpy as np

from calibration.rig_fit.misfit import TermDecision, best, first_order, tried
from calibration.rig_fit.rows import Terms
from calibration.rig_fit.solve import RigProblem


def test_a_term_changes_all_that_it_would_with_those_that_come_along() -> None:
    rng = np.random.default_rng(0)
    terms = Terms(0)
    names = terms.names
    free = [(name,) for name in ("axis_turn_1", "axis_shift_1", "angle_0", "angle_1")]
    new = ("angle_2", "angle_3")
    root = rng.normal(size=(len(names), 3 * len(names)))
    matrix, right = root @ root.T, np.zeros(len(names))
    right[terms.at(new)] = rng.normal(size=2)  # of what is free nothing is left to gain
    problem = RigProblem((), terms, terms.tied(free), np.ones(0, bool))
    solution = SimpleNamespace(matrix=matrix, right=right)
    decision = tried(problem, solution, new, lambda gain: 1.0)
    everything = terms.at([*(name for (name,) in free), *new])
    step = np.zeros(len(names))
    step[everything] = np.linalg.solve(matrix[np.ix_(everything, everything)], right[everything])
    assert np.isclose(decision.value, step[terms.at(["angle_3"])[0]])
    assert np.allclose(first_order(problem, solution, decision), step)


def test_the_term_that_leaves_least_unexplained_comes_in_first() -> None:
    sure = TermDecision("offset_0", True, -0.76, 0.037, "", gain=98257.0)
    right = TermDecision("angle_3", True, -0.0109, 0.0006, "", (("angle_2", -0.006),), 111647.0)
    left_out = TermDecision("bow", False, 0.02, 0.015, "", gain=2e5)
    assert best([sure, right, left_out]) == 1
    assert best([left_out]) is None
