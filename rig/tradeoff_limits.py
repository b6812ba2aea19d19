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


class SceneLimits:
    """The limits of scenes and fogs, whose light is asked for once each. exposures: the most that will be tried."""

    def __init__(self, exposures: int) -> None:
        self._exposures = exposures
        self._lights: dict[tuple[str, str | None], Sequence[RowLight]] = {}

    def beside(self, rows: Sequence[TradeoffRow], config: RigConfig) -> list[TradeoffRow]:
        """The rows of one scene, fog and number of exposures with `times_limit`; without where there is none."""
        if len(config.line_offsets) > 1:
            return list(rows)
        lights = self._lights_of((rows[0].scene, rows[0].fog), config)
        if not lights:
            return list(rows)
        least = {
            averaged: limits(lights, [rows[0].exposures], averaged=averaged)[0].mean_abs_px
            for averaged in dict.fromkeys(map(_averaged, rows))
        }
        return [replace(row, times_limit=row.mean_abs_px / least[_averaged(row)]) for row in rows]

    def _lights_of(self, place: tuple[str, str | None], config: RigConfig) -> Sequence[RowLight]:
        if place not in self._lights:
            scan = config.scan.model_copy(update={"exposures": self._exposures})
            try:
                self._lights[place] = scene_lights(config.model_copy(update={"scan": scan}), rows=ROWS)
            except UsageError:  # a scene whose stripe is nowhere whole can still be scored
                self._lights[place] = ()
        return self._lights[place]


def _averaged(row: TradeoffRow) -> int:
    return COUPLED_ROWS if row.estimator == COUPLED or row.filter == "median" else 1
