"""How sure an answer of `joint` is, from how much worse its rivals are."""

import numpy as np
from numpy.typing import NDArray

from rig.estimators.aggregation_answer import Answer

NATS_PER_UNIT = 1 / 8
RIVAL_WEIGHT, RIVALS = 0.5, 5.0
"""The chance of a rival: RIVALS * exp(-RIVAL_WEIGHT * margin), margin in nats. Four paths say much of the same."""
NONE_WEIGHT = 0.25


def confidence_of(answer: Answer, labels_per_px: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Probability of lying within 1 px, and the standard deviation in px where that is so; float32 (rows, columns)."""
    margin = answer.margin.astype(np.float32) * np.float32(NATS_PER_UNIT)
    none = answer.none.astype(np.float32) * np.float32(NATS_PER_UNIT)
    against = np.float32(RIVALS) * np.exp(np.float32(-RIVAL_WEIGHT) * margin)
    against += np.exp(np.float32(-NONE_WEIGHT) * none)
    return 1 / (1 + against), answer.spread / np.float32(labels_per_px)
