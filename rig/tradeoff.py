"""What accuracy costs in time: scans of the simulated rig over settings, scored by the world's truth (`rig tradeoff`)."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal

from rig.config import RigConfig
from rig.errors import UsageError
from rig.estimators import ESTIMATORS, FILTERS
from rig.run import Progress
from rig.tradeoff_choice import Answer, Wish, choose
from rig.tradeoff_rows import MapScore, Setting, TradeoffRow, row_of, with_fronts
from rig.tradeoff_scan import score_methods

MOST_REPEATS = 1000


@dataclass(frozen=True, slots=True)
class Trials:
    """What is to be tried: every scene in every fog, with every number of exposures, estimator and filter.

    configs: makes the config of a scene (None: the config's own), a fog (None: the scene's own) and exposures. repeat:
    scans of each, seeds `seed`, `seed` + 1 and so on.
    """

    configs: Callable[[str | None, str | None, int], RigConfig]
    scenes: Sequence[str | None]
    fogs: Sequence[str | None]
    exposures: Sequence[int]
    estimators: Sequence[str]
    filters: Sequence[str]
    repeat: int
    seed: int

    def __iter__(self) -> Iterator[tuple[str | None, str | None, int]]:
        """Scene, fog and exposures of every scan; repeats are scans of their own."""
        return product(self.scenes, self.fogs, self.exposures)


@dataclass(frozen=True, slots=True)
class Tradeoff:
    """Rows of all settings; answer: the setting to use, where one was asked for and any counts.

    ci95_by: what the intervals are over. verdict: aborted where an interrupt ended it; the rows are those that were
    whole by then. folder: where everything was written, None where nothing was.
    """

    rows: tuple[TradeoffRow, ...]
    ci95_by: Literal["repeats", "blocks of a map"]
    wish: Wish | None
    answer: Answer | None
    verdict: Literal["complete", "aborted"]
    folder: Path | None = None

    def as_json(self) -> dict[str, Any]:
        """Plain values; `answer` only where a setting was asked for."""
        content: dict[str, Any] = {"rows": [row.as_json() for row in self.rows], "ci95_by": self.ci95_by}
        if self.wish is not None:
            content["answer"] = None if self.answer is None else self.answer.as_json()
        return {**content, "verdict": self.verdict}


def run_tradeoff(trials: Trials, wish: Wish | None, progress: Progress | None = None) -> Tradeoff:
    """Scan and score all of it. progress: called with frames taken and all, of all scans, nominally.

    An interrupt ends it after the last whole row; before there is one it is raised.
    """
    rows: list[TradeoffRow] = []
    verdict: Literal["complete", "aborted"] = "complete"
    try:
        for found in _rows(trials, progress):
            rows += found
    except KeyboardInterrupt:
        if not rows:
            raise
        verdict = "aborted"
    done = with_fronts(rows)
    return Tradeoff(
        rows=done,
        ci95_by="repeats" if trials.repeat > 1 else "blocks of a map",
        wish=wish,
        answer=None if wish is None else choose(done, wish),
        verdict=verdict,
    )


def require_methods(estimators: Sequence[str], filters: Sequence[str]) -> list[str]:
    """What is wrong with names of estimators and filters."""
    return [
        f"{what} {name!r} is unknown; choose of {', '.join(known)}"
        for what, names, known in (("estimator", estimators, ESTIMATORS), ("filter", filters, FILTERS))
        for name in names
        if name not in known
    ]


def _rows(trials: Trials, progress: Progress | None) -> Iterator[list[TradeoffRow]]:
    """The rows of one scene, fog and number of exposures after the other."""
    scans = list(trials)
    bar = _Bar(progress, trials.repeat * sum(exposures for _, _, exposures in scans))
    # All configs before the first scan: what is wrong with one is said at once.
    for (scene, fog, exposures), config in list(zip(scans, _configs(trials, scans), strict=True)):
        scores: dict[tuple[str, str], list[MapScore]] = {}
        for seed in range(trials.seed, trials.seed + trials.repeat):
            found = score_methods(config, trials.estimators, trials.filters, seed, bar.within(exposures))
            for method, score in found.items():
                scores.setdefault(method, []).append(score)
            bar.add(exposures)
        name = str(getattr(config.world, "scene", "")) if scene is None else scene
        yield [row_of(name, fog, Setting(*method, exposures), each) for method, each in scores.items()]


def _configs(trials: Trials, scans: Sequence[tuple[str | None, str | None, int]]) -> list[RigConfig]:
    configs, problems = [], []
    for scan in scans:
        try:
            configs.append(trials.configs(*scan))
        except UsageError as error:
            problems += error.problems
    if problems:
        raise UsageError.of(problems)
    return configs


class _Bar:
    """Progress over scans that take as long as they have exposures, in thousandths."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress = progress
        self._total = total
        self._done = 0

    def within(self, exposures: int) -> Callable[[int, int], None] | None:
        """What a scan of so many exposures is to tell its frames to."""
        if self._progress is None:
            return None
        return lambda done, planned: self._tell(self._done + exposures * min(1.0, done / max(planned, 1)))

    def add(self, exposures: int) -> None:
        """A scan is done."""
        self._done += exposures
        self._tell(self._done)

    def _tell(self, done: float) -> None:
        if self._progress is not None:
            self._progress(round(1000 * done / self._total), 1000)
