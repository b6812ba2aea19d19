"""The stripe table of `joint`: places, light, and how sure each answer is."""

import numpy as np
from numpy.typing import NDArray

from rig.estimators.aggregation_answer import Answer
from rig.estimators.joint_agreement import count_neighbours, new_neighbours
from rig.estimators.joint_confidence import Brightness, confidences
from rig.estimators.placing_kernels import Places
from rig.estimators.row_model import RowModel
from rig.row_threads import RowWorkers
from rig.stripes import StripeTable


def brightness_of(model: RowModel) -> Brightness:
    """What `stripe_table` takes of a learned state."""
    return Brightness(float(model.amplitude[0]), float(model.amplitude[-1]), float(np.median(model.ambient)))


def stripe_table(
    x_px: NDArray[np.float32],
    sd_px: NDArray[np.float32],
    n_frames: NDArray[np.int32],
    answer: Answer,
    places: Places,
    pairs: NDArray[np.float32],
    bright: Brightness,
    workers: RowWorkers,
) -> StripeTable:
    """The table of a map; arrays (rows, columns), x_px NaN where there are no data. pairs: of `pairs_to_ask`."""
    confidence, signal, haze = (np.empty_like(x_px) for _ in range(3))
    neighbours = new_neighbours(pairs)

    def work(first: int, last: int) -> None:
        confidences(x_px, sd_px, n_frames, answer, places, neighbours, bright, first, last, confidence, signal, haze)

    workers.over(len(x_px), lambda first, last: count_neighbours(places.distance, first, last, neighbours))
    workers.over(len(x_px), work)
    return StripeTable(x_px, confidence, sd_px, signal, haze)
