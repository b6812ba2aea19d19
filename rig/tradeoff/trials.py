"""Scans a simulated rig over settings and scores the maps by the world's truth, to show what accuracy costs in time."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product, starmap
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

from rig.batch.case import Case, Result, files_of
from rig.batch.here import do_here
from rig.config.estimators import estimator_names
from rig.config.files import portable_content
from rig.config.models import AUTO, RigConfig
from rig.config.overrides import Config, configure, with_lines
from rig.errors import each_or_problems
from rig.estimate.registry import FILTERS
from rig.progress import Progress, tell_stage
from rig.requests import TradeoffRequest
from rig.tradeoff.choice import Choice, Wish, advice, choose
from rig.tradeoff.limits import SceneLimits
from rig.tradeoff.rows import Place, TradeoffRow, over_repeats, with_fronts
from rig.tradeoff.scan import require_plan, score_methods


class Trial(NamedTuple):
    """One scan to try. scene, lines: None for the config's own. fog: None for the scene's own."""

    scene: str | None
    fog: str | None
    exposures: int
    lines: int | None

    def config(self, config: Config) -> RigConfig:
        """The config with these settings."""
        tried = configure(config, scene=self.scene, fog=self.fog, exposures=self.exposures)
        return tried if self.lines is None else with_lines(tried, self.lines)


Trials = Mapping[Trial, RigConfig]
"""Each trial with its config. A trial is scanned as often as repeats are requested."""


def trials_of(config: Config, asked: TradeoffRequest) -> Trials:
    """The trials of every scene in every fog, with every number of exposures and lines.

    Raises UsageError with the problems of all configs or, if there are none, of all plans. Only plans for the smallest
    and the largest number of exposures are checked.
    """
    scenes, fogs, lines = asked.scenes or (None,), asked.fogs or (None,), asked.lines or (None,)
    trials = list(starmap(Trial, product(scenes, fogs, asked.exposures, lines)))
    configs = dict(zip(trials, each_or_problems(trials, lambda trial: trial.config(config)), strict=True))
    ends = {min(asked.exposures), max(asked.exposures)}
    each_or_problems([made for trial, made in configs.items() if trial.exposures in ends], require_plan)
    return configs


@dataclass(frozen=True, slots=True)
class Tradeoff:
    """Result of a trade-off: the rows of all settings.

    ci95_by: whether confidence intervals come from repeats or from blocks of a map.
    answer: the setting to use; None without a wish, or if each setting has too many missing answers.
    verdict: 'aborted' if an interrupt ended it; the rows are then those that were complete.
    folder: where everything was written; None if nothing was.
    accepted_calibration: reasons against the calibration that was used in spite of them.
    """

    rows: tuple[TradeoffRow, ...]
    ci95_by: Literal["repeats", "blocks of a map"]
    wish: Wish | None
    answer: Choice | None
    verdict: Literal["complete", "aborted"]
    folder: Path | None = None
    accepted_calibration: tuple[str, ...] = ()

    @property
    def advice(self) -> str:
        """A sentence that says which setting to take."""
        of = "of what was whole by then, " if self.verdict == "aborted" else ""
        return of + advice(self.rows, self.wish, self.answer)

    def as_json(self) -> dict[str, Any]:
        """The result as plain values; `answer` only if there was a wish."""
        content: dict[str, Any] = {
            "advice": self.advice,
            "rows": [asdict(row) for row in self.rows],
            "ci95_by": self.ci95_by,
        }
        if self.wish is not None:
            content["answer"] = None if self.answer is None else self.answer.as_json()
        if self.accepted_calibration:
            content["accepted_calibration"] = list(self.accepted_calibration)
        return {**content, "verdict": self.verdict}


def cases_of(trials: Trials, asked: TradeoffRequest) -> list[Case]:
    """A case for each repeat of each trial, trial by trial and seed by seed. It is for all estimators and filters
    together."""
    cases = []
    for trial, config in trials.items():
        scene = str(getattr(config.world, "scene", "")) if trial.scene is None else trial.scene
        setting = {"scene": scene, "fog": trial.fog, "exposures": trial.exposures, "lines": len(config.line_offsets)}
        content = portable_content(config)
        inputs = {"config": content, "place": [scene, trial.fog], "methods": [asked.estimators, asked.filters]}
        files = files_of(content)
        for seed in range(asked.seed, asked.seed + asked.repeat):
            cases.append(Case(f"{__name__}:scan_once", {**inputs, "seed": seed}, {**setting, "seed": seed}, files))
    return cases


OF_ALL_ROWS: Final = (
    "compute_ms", "times_limit", "exponent_nats", "times_wrong_limit", "position_sd_px", "times_position_limit",
    "pareto", "pareto_compute",
)  # fmt: skip
"""Fields of a row that its scan alone does not decide: it is compared with others, or depends on the computer."""


def scan_once(
    config: Mapping[str, Any], place: Place, methods: tuple[Sequence[str], Sequence[str]], seed: int
) -> dict[str, Any]:
    """One scan, for a case of `cases_of`: rows of all estimators and filters as plain values, and apart from them their
    computing times. methods: estimators, filters."""
    rows = score_methods(RigConfig.model_validate(config), (place[0], place[1]), *methods, seed)
    return {
        "rows": [{key: value for key, value in asdict(row).items() if key not in OF_ALL_ROWS} for row in rows],
        "measured": {"compute_ms": [row.compute_ms for row in rows]},
    }


def tabulate(
    trials: Trials,
    asked: TradeoffRequest,
    wish: Wish | None,
    found: Sequence[Result | None],
    verdict: Literal["complete", "aborted"] = "complete",
) -> Tradeoff:
    """Make the trade-off from the results of the cases of `cases_of`. Trials with a missing result (None) are left out.
    Limits are added if they are asked for and the verdict is 'complete'."""
    rows: list[TradeoffRow] = []
    limits = SceneLimits(asked.exposures)
    for number, config in enumerate(trials.values()):
        results = found[number * asked.repeat : (number + 1) * asked.repeat]
        repeats = [rows_of(result) for result in results if result is not None]
        if len(repeats) < asked.repeat:
            continue
        of_trial = list(map(over_repeats, zip(*repeats, strict=True)))
        if asked.limits and verdict == "complete":  # who has interrupted wants to see what is there
            tell_stage("finding what the light allows")
            of_trial = limits.beside(of_trial, config)
        rows += of_trial
    done = with_fronts(rows)
    return Tradeoff(
        rows=done,
        ci95_by="repeats" if asked.repeat > 1 else "blocks of a map",
        wish=wish,
        answer=None if wish is None else choose(done, wish),
        verdict=verdict,
    )


def rows_of(result: Result) -> list[TradeoffRow]:
    """The rows in the result of `scan_once`."""
    times_ms = result["measured"]["compute_ms"]
    return [
        TradeoffRow(**{**row, "ci95": tuple(row["ci95"]), "compute_ms": time_ms})
        for row, time_ms in zip(result["rows"], times_ms, strict=True)
    ]


def run_tradeoff(
    trials: Trials, asked: TradeoffRequest, wish: Wish | None, progress: Progress | None = None
) -> Tradeoff:
    """Scan and score all trials in this process, one after the other, so that each has the computer for itself.

    progress: called with the number of scans done and of all.

    An interrupt ends the trade-off after the last complete trial; before the first complete one it is raised again.
    """
    found, aborted = do_here(cases_of(trials, asked), "scan", progress)
    done = tabulate(trials, asked, wish, found, "aborted" if aborted else "complete")
    if not done.rows:
        raise KeyboardInterrupt
    return done


def method_problems(estimators: Sequence[str], filters: Sequence[str]) -> list[str]:
    """A line for each name that is no estimator or no filter."""
    return [
        f"{what} {name!r} {'is a choice between others' if (what, name) == ('estimator', AUTO) else 'is unknown'}; "
        f"choose of {', '.join(known)}"
        for what, names, known in (("estimator", estimators, estimator_names()), ("filter", filters, FILTERS))
        for name in names
        if name not in known
    ]
