"""How far errors are from what the light of a scene allows: `rig.limits`, beside the rows of a trade-off."""

from collections.abc import Sequence
from dataclasses import replace

from rig.config import RigConfig
from rig.errors import UsageError
from rig.limits import COUPLED_ROWS, limits
from rig.row_light import RowLight
from rig.scene_limits import scene_lights
from rig.tradeoff_rows import TradeoffRow

ROWS = 200
"""Rows of a scene that its limit is the mean of."""
COUPLED = "joint"
"""The estimator that sees a row together with its neighbours; the median filter sees as many."""


Place = tuple[str, str | None]
"""Scene and fog."""


class SceneLimits:
    """The limits of scenes and fogs, each worked out once. exposures: all that will be tried."""

    def __init__(self, exposures: Sequence[int]) -> None:
        self._exposures = tuple(exposures)
        self._lights: dict[Place, Sequence[RowLight]] = {}
        self._least_px: dict[tuple[Place, int], dict[int, float]] = {}

    def beside(self, rows: Sequence[TradeoffRow], config: RigConfig) -> list[TradeoffRow]:
        """The rows of one scene and fog with `times_limit`; without where there is none. config: of their scan."""
        if len(config.line_offsets) > 1:
            return list(rows)
        place = rows[0].scene, rows[0].fog
        if place not in self._lights:
            self._lights[place] = self._lights_of(config)
        return [self._with_limit(row, place) for row in rows] if self._lights[place] else list(rows)

    def _with_limit(self, row: TradeoffRow, place: Place) -> TradeoffRow:
        averaged = _averaged(row)
        if (place, averaged) not in self._least_px:
            found = limits(self._lights[place], self._exposures, averaged=averaged)
            self._least_px[place, averaged] = {limit.exposures: limit.mean_abs_px for limit in found}
        return replace(row, times_limit=row.mean_abs_px / self._least_px[place, averaged][row.exposures])

    def _lights_of(self, config: RigConfig) -> Sequence[RowLight]:
        # What the world leaves out must be too little for the most exposures.
        scan = config.scan.model_copy(update={"exposures": max(self._exposures)})
        try:
            return scene_lights(config.model_copy(update={"scan": scan}), rows=ROWS)
        except UsageError:  # a scene whose stripe is nowhere whole can still be scored
            return ()


def _averaged(row: TradeoffRow) -> int:
    return COUPLED_ROWS if row.estimator == COUPLED or row.filter == "median" else 1
