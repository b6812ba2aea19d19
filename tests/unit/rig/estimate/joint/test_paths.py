"""Four-path aggregation against whole-array integers: sums to the bit, and what is read off them."""

import numpy as np
import pytest

from rig.estimate.joint import paths, vote, winner
from rig.estimate.joint.paths import CHUNK, JUMP, ONE, THREE, TWO, along_columns, along_rows
from rig.estimate.joint.winner import BETA, UNITS, LabelAnswers, answer_settings, new_answer, new_readout
from rig.simd.memory import pointers
from rig.threads import RowWorkers
from tests.stability.inventory import covers

covers(paths, winner, vote)


def messages(cost, axis, reverse):
    """Messages int (rows, columns, labels) of one path, none of whose numbers wraps."""
    along = np.moveaxis(cost.astype(int), axis, 0)
    along = along[::-1] if reverse else along
    sent, last = np.zeros_like(along), along[0]
    for i in range(1, len(along)):
        least = last.min(axis=-1, keepdims=True)
        beyond = np.pad(last, ((0, 0), (3, 3)), constant_values=10**6)
        options = [last, np.broadcast_to(least + JUMP, last.shape)]
        for step, penalty in ((1, ONE), (2, TWO), (3, THREE)):
            options += [beyond[:, 3 + by : beyond.shape[1] - 3 + by] + penalty for by in (-step, step)]
        sent[i] = np.minimum.reduce(options) - least
        last = np.minimum(along[i] + sent[i], 255)
    return np.moveaxis(sent[::-1] if reverse else sent, 0, axis)


def around(total, label, reach):
    """Mean of the labels around one, as far as both sides have totals below 255."""
    weights, shifts = [1.0], [0]
    for k in range(1, reach + 1):
        if label - k < 0 or label + k >= len(total) or max(total[label - k], total[label + k]) >= 255:
            break
        weights += list(np.exp(-BETA / UNITS * (total[[label - k, label + k]] - total[label])))
        shifts += [-k, k]
    return label + np.average(shifts, weights=weights)


def answer_of(total, stripes):
    """The fields of an answer for one pixel."""
    stripe = total[:stripes]
    label = int(stripe.argmin())
    away = np.abs(np.arange(stripes) - label)
    return around(stripe, label, 4), stripe[away >= 3].min(initial=255) - stripe[label]


def costs_of(seed, shape, stripes):
    """Random costs: noise, ties, a clear surface and flat stretches, pixels where some or all labels are excluded."""
    rng = np.random.default_rng(seed)
    rows, columns, labels = shape
    cost = rng.integers(0, 161, shape)
    cost[rng.random((rows, columns)) < 0.3] //= 60
    surface = np.clip(np.arange(rows)[:, None] // 2 + np.arange(columns) + rng.integers(0, stripes), 0, stripes - 1)
    clear = rng.random((rows, columns)) < 0.5
    depth = np.minimum(20 * np.abs(np.arange(labels) - surface[:, :, None]), 160)
    cost[clear] = depth[clear]
    cost[rng.random((rows, columns)) < 0.1] = 0
    first = rng.integers(0, stripes, (rows, columns))
    cost[(np.arange(labels) < first[:, :, None]) & (rng.random((rows, columns)) < 0.2)[:, :, None]] = 255
    cost[:, :, stripes:] = 255
    cost[rng.random((rows, columns)) < 0.05] = 255
    return cost.astype(np.uint8)


def aggregated(cost, settings):
    message, out = np.full_like(cost, 77), new_answer(*cost.shape[:2])
    cost = cost.copy()
    with RowWorkers(3) as workers:
        workers.over(cost.shape[0], lambda a, b: along_rows(cost, message, a, b))
        horizontal = message.copy()

        def columns(first, last):
            desk = new_readout(settings, out, CHUNK, cost.shape[2])
            along_columns(cost, message, first, last, pointers(desk))

        workers.over(cost.shape[1], columns)
    return horizontal, message, out


def check(cost, stripes):
    horizontal, message, out = aggregated(cost, answer_settings(stripes))
    wanted = messages(cost, 1, False) + messages(cost, 1, True)
    np.testing.assert_array_equal(horizontal, wanted)
    wanted += messages(cost, 0, False)
    np.testing.assert_array_equal(message, wanted)
    total = np.minimum(cost + wanted + messages(cost, 0, True), 255)
    answers = [[answer_of(total[y, x], stripes) for x in range(cost.shape[1])] for y in range(cost.shape[0])]
    for name, found, right in zip(LabelAnswers._fields, out, np.moveaxis(np.array(answers), 2, 0), strict=True):
        tolerance = {"rtol": 2e-7, "atol": 1e-5} if found.dtype == np.float32 else {"rtol": 0}
        np.testing.assert_allclose(found, right, err_msg=name, **tolerance)


@pytest.mark.parametrize(
    ("shape", "stripes"), [((20, 9, 64), 58), ((17, 12, 128), 128), ((6, 11, 320), 305), ((1, 19, 128), 97)]
)
def test_sums_are_exact_and_answers_follow(shape, stripes):
    check(costs_of(sum(shape), shape, stripes), stripes)


@pytest.mark.parametrize("fill", [0, 160, 255])
def test_nothing_wraps_round_where_all_is_alike(fill):
    cost = np.full((6, 7, 64), fill, np.uint8)
    check(cost, 58)
    cost[3, 3] = 255 - fill
    cost[:, 4, 10] = 0
    check(cost, 58)
