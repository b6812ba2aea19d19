"""Chooses the setting to use: the smallest error within a time, or the shortest time within an error.

A setting is judged by its worst result among the scenes and fogs that were tried, since the requirement has to hold in
all of them.
"""

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from calibration.errors import digits
from drivers.units import parse_quantity
from rig.errors import UsageError
from rig.tradeoff.rows import Clock, TradeoffRow, TrialSetting

_PIXELS = re.compile(r"\s*(\d+\.?\d*(?:[eE][+-]?\d{1,3})?|\.\d+)\s*px\s*", re.ASCII)
WORTH = 1.5
"""Without a wish, the shortest scan within this factor of the least error is advised: a longer one gains little."""


@dataclass(frozen=True, slots=True)
class Wish:
    """The user's requirement: exactly one of a time and an error. of: whether sensor or computer time counts."""

    time_ms: float | None = None
    error_px: float | None = None
    of: Clock = "sensor"

    def __str__(self) -> str:
        """Say the wish in words."""
        if self.time_ms is not None:
            return f"at most {self.time_ms:g} ms of {self.of} time a map"
        return f"at most {self.error_px:g} px of error"


@dataclass(frozen=True, slots=True)
class Choice:
    """The setting to use or, if none meets the wish, the nearest. Its figures are its worst in any scene and fog."""

    wish: Wish
    fits: bool
    setting: TrialSetting
    mean_abs_px: float
    sensor_ms: float
    compute_ms: float

    def __str__(self) -> str:
        """Say the choice in words."""
        if self.fits:
            return f"for {self.wish}: {self.setting}: {self.figures}"
        nearest = f"{self.setting}: {self.figures}"
        return f"nothing tried gives {self.wish}; nearest is {nearest}; try other exposures or estimators"

    @property
    def figures(self) -> str:
        """Error and times as text."""
        return (
            f"{digits(self.mean_abs_px)} px in {digits(self.sensor_ms)} ms of sensor and "
            f"{digits(self.compute_ms)} ms of computing a map"
        )

    def as_json(self) -> dict[str, Any]:
        """The choice as plain values."""
        wish = {"time_budget_ms": self.wish.time_ms, "error_px": self.wish.error_px, "of": self.wish.of}
        figures = {name: getattr(self, name) for name in ("mean_abs_px", "sensor_ms", "compute_ms")}
        return {"asked": wish, "fits": self.fits, **asdict(self.setting), **figures}


def wish_of(time_budget: str | None, error: str | None, of: str) -> Wish | None:
    """The wish from texts such as '20 ms' and '0.1 px', of which one may be given; None without either. Raises
    UsageError with all problems."""
    problems = []
    time_ms = error_px = None
    if of not in ("sensor", "compute"):
        problems.append(f"`of` is {of!r}; the time is that of sensor or compute")
    if time_budget is not None and error is not None:
        problems.append("`time_budget` and `error` ask for two things; give one of them")
    if time_budget is not None:
        try:
            time_ms = 1e3 * parse_quantity(time_budget, "time")
        except ValueError as wrong:
            problems.append(f"`time_budget` {wrong}")
    if error is not None:
        match = _PIXELS.fullmatch(error)
        if match is None:
            problems.append(f"`error` {error!r} is no number of pixels; write e.g. '0.1 px'")
        else:
            error_px = float(match[1])
    for name, text, value in (("`time_budget`", time_budget, time_ms), ("`error`", error, error_px)):
        if value is not None and value <= 0:
            problems.append(f"{name} is {text}; it must be more than 0")
    if problems:
        raise UsageError.of(problems)
    if time_ms is None and error_px is None:
        return None
    return Wish(time_ms, error_px, "compute" if of == "compute" else "sensor")


def choose(rows: Sequence[TradeoffRow], wish: Wish) -> Choice | None:
    """Choose among the settings that were tried in every scene and fog.

    None if each of them has too many missing answers in some scene and fog.
    """
    by_setting: dict[TrialSetting, list[TradeoffRow]] = {}
    for row in rows:
        by_setting.setdefault(row.setting, []).append(row)
    places = max((len(found) for found in by_setting.values()), default=0)
    answers = [
        _answer(wish, setting, found)
        for setting, found in by_setting.items()
        if len(found) == places and all(row.counts for row in found)
    ]
    if not answers:
        return None

    def time_ms(answer: Choice) -> float:
        return answer.sensor_ms if wish.of == "sensor" else answer.compute_ms

    fitting = [answer for answer in answers if answer.fits]
    by_error = (wish.time_ms is not None) == bool(fitting)
    if by_error:
        return min(fitting or answers, key=lambda answer: (answer.mean_abs_px, time_ms(answer)))
    return min(fitting or answers, key=lambda answer: (time_ms(answer), answer.mean_abs_px))


def advice(rows: Sequence[TradeoffRow], wish: Wish | None, answer: Choice | None) -> str:
    """Say in a sentence which setting to take.

    It is `answer`, the choice for the wish, or without a wish the shortest scan with an error of at most `WORTH` times
    the smallest of all.
    """
    if wish is not None and answer is not None:
        return f"take {answer.setting}: {answer.figures}, the best for {wish}" if answer.fits else str(answer)
    least = choose(rows, Wish(error_px=0.0))
    if least is None:
        return "no setting can be named: every one leaves more than 5 % of the answers out; raise exposures"
    found = choose(rows, Wish(error_px=WORTH * least.mean_abs_px))
    assert found is not None, "the one with the least error fits"
    why = f"the shortest scan within {WORTH:g} times the least error, {digits(least.mean_abs_px)} px"
    return f"take {found.setting}: {found.figures}; {why}"


def _answer(wish: Wish, setting: TrialSetting, rows: Sequence[TradeoffRow]) -> Choice:
    error_px = max(row.mean_abs_px for row in rows)
    sensor_ms, compute_ms = max(row.sensor_ms for row in rows), max(row.compute_ms for row in rows)
    time_ms = sensor_ms if wish.of == "sensor" else compute_ms
    fits = (wish.time_ms is None or time_ms <= wish.time_ms) and (wish.error_px is None or error_px <= wish.error_px)
    return Choice(wish, fits, setting, error_px, sensor_ms, compute_ms)
