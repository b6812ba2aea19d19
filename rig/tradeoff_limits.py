"""How far errors are from what the light of a scene allows: `rig.limits`, beside the rows of a trade-off."""

import math
from collections.abc import Sequence
from dataclasses import replace

from rig.config import RigConfig
from rig.errors import UsageError
from rig.limits import COUPLED_ROWS, Limit, limits
from rig.row_light import RowLight
from rig.scene_limits import scene_lights
from rig.tradeoff_rows import LOCAL_PX, TradeoffRow

ROWS = 200
"""Rows of a scene that its limit is the mean of."""
COUPLED = "joint"
"""The estimator that sees a row together with its neighbours; the median filter sees as many."""
LEAST_WRONG = 0.003
"""Share of the ideal's answers more than 1 px off from which there is a ratio to it: twenty of 200 rows x 32 draws."""
LOCAL_SDS = 3.0
"""Answers within LOCAL_PX are all of those that found the stripe where so many standard deviations fit into that."""

Place = tuple[str, str | None]
"""Scene and fog."""


class SceneLimits:
    """The limits of scenes and fogs, each worked out once. exposures: all that will be tried."""

    def __init__(self, exposures: Sequence[int]) -> None:
        self._exposures = tuple(exposures)
        self._lights: dict[Place, Sequence[RowLight]] = {}
        self._found: dict[tuple[Place, int], dict[int, Limit]] = {}

    def beside(self, rows: Sequence[TradeoffRow], config: RigConfig) -> list[TradeoffRow]:
        """The rows of one scene and fog with what they can be held against; as they are where there is no limit.

        config: of their scan.
        """
        if len(config.line_offsets) > 1:
            return list(rows)
        place = rows[0].scene, rows[0].fog
        if place not in self._lights:
            self._lights[place] = self._lights_of(config)
        return [self._with_limit(row, place) for row in rows] if self._lights[place] else list(rows)

    def _with_limit(self, row: TradeoffRow, place: Place) -> TradeoffRow:
        averaged = _averaged(row)
        if (place, averaged) not in self._found:
            found = limits(self._lights[place], self._exposures, averaged=averaged)
            self._found[place, averaged] = {limit.exposures: limit for limit in found}
        return _beside(row, self._found[place, averaged][row.exposures])

    def _lights_of(self, config: RigConfig) -> Sequence[RowLight]:
        # What the world leaves out must be too little for the most exposures.
        scan = config.scan.model_copy(update={"exposures": max(self._exposures)})
        try:
            return scene_lights(config.model_copy(update={"scan": scan}), rows=ROWS)
        except UsageError:  # a scene whose stripe is nowhere whole can still be scored
            return ()


def _averaged(row: TradeoffRow) -> int:
    return COUPLED_ROWS if row.estimator == COUPLED or row.filter == "median" else 1


def _beside(row: TradeoffRow, limit: Limit) -> TradeoffRow:
    """A row beside its limit; each figure None where it is not known, or would say something else."""
    wrong, least_wrong = 1.0 - row.within_1px, 1.0 - limit.within_1px
    bound_px, sd_px = limit.position_sd_px, row.local_sd_px
    local = LOCAL_SDS * bound_px <= LOCAL_PX
    return replace(
        row,
        times_limit=row.mean_abs_px / limit.mean_abs_px,
        exponent_nats=_finite(limit.exponent * limit.averaged),
        times_wrong_limit=wrong / least_wrong if least_wrong >= LEAST_WRONG else None,
        position_sd_px=_finite(bound_px),
        times_position_limit=sd_px / bound_px if sd_px is not None and local else None,
    )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
