"""The vote on weak answers against plain loops, and what it is there for: streaks go, what the counts say stays."""

import numpy as np

from rig.estimate.joint.vote import FAR, OBJECTION, REACH, SAME, WEAK, collect, new_ballots, vote
from rig.estimate.joint.winner import LabelAnswers
from rig.threads import RowWorkers

LABELS = 64


def voted(answer, cost, threads=1):
    rows, columns = answer.label.shape
    out, ballots = LabelAnswers(answer.label.copy(), answer.margin.copy()), new_ballots(rows, columns)
    with RowWorkers(threads) as workers:
        workers.over(columns, lambda a, b: collect(out, a, b, ballots))
        workers.over(rows, lambda a, b: vote(ballots, cost, a, b, out))
    return out


def wanted(answer, cost):
    """The same by the formula, answer by answer."""
    label, margin = answer.label.copy(), answer.margin.copy()
    whole, votes = np.floor(answer.label + 0.5).astype(int), answer.margin.astype(int) // 4
    for y, c in np.argwhere(answer.margin < WEAK):
        around = np.s_[max(y - REACH, 0) : y + REACH + 1, max(c - REACH, 0) : c + REACH + 1]
        places = [(y, c), (y, c - 1), (y, c + 1), (y - 1, c), (y + 1, c)]
        places = [at for at in places if 0 <= at[0] < whole.shape[0] and 0 <= at[1] < whole.shape[1]]
        against = [np.sum(votes[around] * np.minimum(abs(whole[around] - whole[at]), FAR)) for at in places]
        best = places[int(np.argmin(against))]
        if int(cost[y, c, whole[best]]) > int(cost[y, c, whole[y, c]]) + OBJECTION:
            best = (y, c)
        same = abs(whole[around] - whole[best]) <= SAME
        label[y, c] = answer.label[best]
        support = np.where(same, votes[around], -votes[around]).sum()
        margin[y, c] = max(support, 0) * 4 // same.size
    return LabelAnswers(label, margin)


def flat(rows=9, columns=40, label=20.0, margin=30):
    """A surface that all answers agree on, and costs that say nothing."""
    answer = LabelAnswers(np.full((rows, columns), label, np.float32), np.full((rows, columns), margin, np.uint8))
    return answer, np.zeros((rows, columns, LABELS), np.uint8)


def test_votes_are_those_of_the_formula_for_any_number_of_threads():
    rng = np.random.default_rng(4)
    for shape in ((23, 50), (3, 7), (40, 16)):
        base = rng.integers(0, LABELS, (5, 5)).repeat(10, 0).repeat(10, 1)[: shape[0], : shape[1]]
        label = np.clip(base + rng.integers(-2, 3, shape) * rng.integers(0, 2, shape), 0, LABELS - 1)
        label = np.where(rng.random(shape) < 0.2, rng.integers(0, LABELS, shape), label).astype(np.float32)
        margin = rng.integers(0, 2 * WEAK, shape).astype(np.uint8)
        margin[rng.random(shape) < 0.1] = 255
        cost = rng.integers(0, 3 * OBJECTION, (*shape, LABELS)).astype(np.uint8)
        expected = wanted(LabelAnswers(label, margin), cost)
        for threads in (1, 2):
            out = voted(LabelAnswers(label, margin), cost, threads)
            np.testing.assert_array_equal(out.label, expected.label)
            np.testing.assert_array_equal(out.margin, expected.margin)


def test_a_streak_goes_and_its_place_is_as_sure_as_those_around_it():
    answer, cost = flat()
    answer.label[4, 5:30] = 50.0
    out = voted(answer, cost)
    np.testing.assert_array_equal(out.label, 20.0)
    assert 10 < out.margin[4, 15] < 30
