"""The stripe table of `joint`: places, and how sure each is, from how much worse its rivals are."""

import numpy as np
from numpy.typing import NDArray

from rig.estimators.aggregation_answer import Answer
from rig.estimators.placing_kernels import Places
from rig.estimators.row_input import State
from rig.stripes import StripeTable

NATS_PER_UNIT = np.float32(1 / 8)
RIVAL_WEIGHT, RIVALS = np.float32(0.5), np.float32(5.0)
"""The chance of a rival: RIVALS * exp(-RIVAL_WEIGHT * margin), margin in nats. Four paths say much of the same."""
NONE_WEIGHT = np.float32(0.25)


def stripe_table(
    x_px: NDArray[np.float32], sd_px: NDArray[np.float32], answer: Answer, places: Places, state: State
) -> StripeTable:
    """The table of a map; arrays float32 (rows, columns), x_px NaN where there are no data."""
    nothing = np.isnan(x_px)
    confidence = np.where(nothing, np.float32(0.0), _confidence(answer))
    dimmest, brightest = places.scale * state.amplitude[0], places.scale * state.amplitude[-1]
    signal = np.clip(places.light, dimmest, brightest)
    nan = np.float32(np.nan)
    return StripeTable(
        x_px, confidence, np.where(nothing, nan, sd_px), np.where(nothing, nan, signal),
        np.where(nothing, nan, places.haze),
    )  # fmt: skip


def _confidence(answer: Answer) -> NDArray[np.float32]:
    against = RIVALS * np.exp(-RIVAL_WEIGHT * NATS_PER_UNIT * answer.margin)
    against += np.exp(-NONE_WEIGHT * NATS_PER_UNIT * np.maximum(answer.none, np.int16(-1000)))
    return np.asarray(1 / (1 + against), np.float32)
