"""Compiled part of the label costs: what the halo says, added to the constants of each row of a batch."""

from typing import Final, NamedTuple

import numba
import numpy as np

from rig.estimators.halo_tables import BLOCK_PX, FIRST_PX
from rig.estimators.label_places import PHASES
from rig.estimators.label_tables import LIGHTS
from rig.estimators.label_volume_buffers import BATCH, POSITION, At, Buffers, Fitted, signed_address
from rig.lane_memory import (
    load_float32,
    load_int16,
    read_int16,
    read_int32,
    store_int16,
    write_int16,
    write_int32,
)
from rig.lanes import LANES, add_saturated, larger_float, scaled, smaller, smaller_float, to_int16, zero_int16

_LIMIT: Final = np.float32(30000)
_TO_UNSIGNED: Final = np.float32(32768.5)
_POSSIBLE: Final = np.int16(28000)
"""Constants of positions without a label lie below the negative of this, others above."""


class HaloAt(NamedTuple):
    """Addresses, for `rig.lane_memory`, and numbers of elements: tables, see there, and room.

    fitted: constants of all places for a column's exposures; mean: counts of blocks; level: what the halo says of a
    stripe at each place; constant: of the positions, of each row of a batch; which: int32, its number there.
    """

    weight: int
    per_column: int
    constants: int
    ramp: int
    blocks: int
    places: int
    fitted: int
    mean: int
    level: int
    constant: int
    which: int


@numba.njit(forceinline=True)
def halo_at(tables, begin, constants):  # type: ignore[no-untyped-def]
    """Where all of it lies, with room from an address on, and where that ends; constants: of positions of a row."""
    blocks, places = tables.weight.shape[2], tables.weight.shape[4]
    mean = begin + 2 * LIGHTS * places
    level = mean + 2 * (blocks + LANES)
    constant = level + 2 * LIGHTS * places
    which = constant + 2 * BATCH * constants
    at = HaloAt(
        signed_address(tables.weight), blocks * LIGHTS * places, signed_address(tables.constant),
        signed_address(tables.ramp), blocks, places, begin, mean, level, constant, which,
    )  # fmt: skip
    return at, which + 4 * BATCH


@numba.njit(cache=True, nogil=True)
def fit_halo(halo: HaloAt, column: int, per_nat: float) -> None:
    """Fill fitted for a column's exposures, and which; column: its number in its band, per_nat: units x exposures."""
    numbers = LIGHTS * halo.places
    for j in range(0, numbers, LANES):
        nats = load_float32(halo.constants + 4 * column * numbers, j) * np.float32(per_nat)
        nats = larger_float(smaller_float(nats, _LIMIT), -_LIMIT)
        store_int16(halo.fitted, j, to_int16(nats + _TO_UNSIGNED) + np.int16(-32768))
    for r in range(BATCH):
        write_int32(halo.which, r, np.int32(r))


@numba.njit(cache=True, nogil=True)
def halo_rows(halo: HaloAt, column: int, at: At, fitted: Fitted, b: Buffers, batch: int) -> None:
    """Fill constant: those of the rows' tables and what the halo says."""
    vectors = b.score_row // (PHASES * LANES)
    weights = halo.weight + 2 * column * halo.per_column
    for r in range(batch):
        i = read_int32(b.here, r)
        if i < 0:
            continue
        n, first, end = b.n + 2 * r * b.n_row, read_int16(at.span, 2 * i), read_int16(at.span, 2 * i + 1)
        for k in range(halo.blocks):
            begin, total = FIRST_PX + BLOCK_PX * k, 0
            for p in range(max(begin, first), min(begin + BLOCK_PX, end)):
                total += read_int16(n, p)
            write_int16(halo.mean, k, np.int16(total // BLOCK_PX))
        for j in range(0, LIGHTS * halo.places, LANES):
            says = load_int16(halo.fitted, j)
            for k in range(halo.blocks):
                mean = zero_int16() + read_int16(halo.mean, k)
                says = add_saturated(says, scaled(mean, load_int16(weights, k * LIGHTS * halo.places + j)))
            store_int16(halo.level, j, says)
        source = fitted.constant + 2 * at.constants * read_int32(b.fitted, r)
        to = halo.constant + 2 * at.constants * r
        for v in range(vectors):
            for m in range(LIGHTS):
                place = m * halo.places + LANES // BLOCK_PX * v
                first = zero_int16() + read_int16(halo.level, place)
                second = zero_int16() + read_int16(halo.level, place + 1)
                third = zero_int16() + read_int16(halo.level, place + 2)
                for phase in range(PHASES):
                    ramp = halo.ramp + 2 * 3 * LANES * phase
                    says = scaled(first, load_int16(ramp, 0)) + scaled(second, load_int16(ramp, LANES))
                    says = says + scaled(third, load_int16(ramp, 2 * LANES))
                    j = v * POSITION + (phase * LIGHTS + m) * LANES
                    constant = load_int16(source, j)
                    # Positions without a label stay so whatever the halo says.
                    never = smaller(constant + _POSSIBLE, np.int16(0)) << 4
                    store_int16(to, j, add_saturated(add_saturated(constant, says), never))
