"""The call that measures depth in other ways besides the line scan: `compare_strategies`."""

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, cast

from drivers.units import parse_quantity
from rig.api.tradeoffs import WriteResults
from rig.batch.case import Case, Result
from rig.config.bundled import short_names
from rig.config.models import RigConfig
from rig.config.overrides import MAX_SEED, SIMULATED, Config, configure
from rig.errors import UsageError, each_or_problems, noted
from rig.interrupts import one_interrupt
from rig.progress import Progress
from rig.requests import StrategiesRequest, TradeoffRequest
from rig.run_folder.folder import RunFolder
from rig.strategies.apparatus import Rule
from rig.strategies.comparison.compare import (
    Comparison,
    ComparisonPlan,
    cases_of,
    run_comparison,
    tabulate,
)
from rig.strategies.comparison.files import write_files
from rig.strategies.comparison.places import OWN, air_problems, rig_model, scene_file
from rig.strategies.comparison.scene import LINES
from rig.strategies.strategy import Strategy, find_strategy, strategy_names

ALL: Final = "all"
AIRS: Final = ("clear", "50m", "20m", "10m", "rain", "snow")
"""Air that is tried if the caller names none: clear air, light, moderate and dense fog, rain and snow."""
TIMES: Final = ("1ms", "10ms", "50ms", "200ms", "1s")
RULES: Final[tuple[Rule, ...]] = ("energy", "irradiance")
SCENES: Final = ("street", "ramp")
LONGEST_S: Final = 100.0
"""Longest measurement: 10 million frames of 10 us, which counters and estimators can hold."""
SHARED: Final = ("scenes", "fogs", "repeat", "seed", "out")
"""Options of a trade-off that hold here too."""


def compare_strategies(
    config: Config = SIMULATED,
    request: StrategiesRequest | None = None,
    *,
    progress: Progress | None = None,
    **changes: Any,
) -> Comparison:
    """Measure depth in many ways, in front of the same simulated scenes with the same light (`rig tradeoff
    --strategies`).

    request, changes: options, as a `StrategiesRequest` or by the names of its fields:
      `compare_strategies(strategies=["line-joint", "gray-spad"], fogs=["clear", "20m"])`. No strategy means all.
    progress: called with the number of measurements done and the total.

    Raises UsageError, one line per problem. An interrupt ends the comparison after the last complete row, with verdict
    'aborted'.
    """
    request = replace(request or StrategiesRequest(), **changes)
    loaded, ways, asked = _prepared(config, request)
    if request.out is None:
        return run_comparison(loaded, ways, asked, progress)
    with one_interrupt(), RunFolder(request.out) as folder:
        return write_files(folder, run_comparison(loaded, ways, asked, progress), _settings(loaded, asked))


def as_cases(config: Config, request: StrategiesRequest) -> tuple[list[Case], WriteResults]:
    """The measurements of a comparison as cases, and a function that writes the comparison of their results into a
    folder.

    The function takes None for a result that is missing. Raises UsageError as `compare_strategies` does.
    """
    loaded, ways, asked = _prepared(config, request)

    def write(folder: RunFolder, found: list[Result | None], aborted: bool) -> object:
        done = tabulate(ways, found, "aborted" if aborted else "complete")
        return write_files(folder, done, _settings(loaded, asked)) if done.rows else None

    texts = {parse_quantity(text, "time"): text for text in _once(request.times) or TIMES}
    cases = cases_of(loaded, ways, asked)
    return [replace(case, labels={**case.labels, "time": texts[case.labels["time"]]}) for case in cases], write


def _prepared(config: Config, request: StrategiesRequest) -> tuple[RigConfig, list[Strategy], ComparisonPlan]:
    """Check a request. Raises UsageError with all problems."""
    loaded = configure(config)
    names = list(dict.fromkeys(request.strategies)) or [ALL]
    problems = _of_rig_and_request(loaded, request)
    airs, times = _once(request.fogs) or AIRS, _once(request.times) or TIMES
    problems += air_problems(airs)
    times_s = []
    for text in times:
        try:
            times_s.append(parse_quantity(text, "time"))
        except ValueError as wrong:
            problems.append(f"`times` {wrong}")
        else:
            if not 0 < times_s[-1] <= LONGEST_S:
                problems.append(f"`times` has {text}; a measurement takes more than 0 s and at most {LONGEST_S:g} s")
    with noted(problems):
        ways = each_or_problems([name for name in names if name != ALL], find_strategy)
        if ALL in names:  # our own way first
            every = sorted(strategy_names(), key=lambda name: (not name.startswith("line"), name))
            ways = each_or_problems(every, find_strategy)
    scenes = {name: scene for scene, name in short_names(_once(request.scenes) or SCENES).items()}
    # A scene that cannot be read is told before others have been measured.
    with noted(problems), TemporaryDirectory() as made:
        model = rig_model(loaded)
        if request.rows > max(model.camera.height, StrategiesRequest().rows):
            problems.append(f"`rows` is {request.rows}; the camera has {model.camera.height}")
        each_or_problems(scenes.values(), lambda scene: scene_file(scene, None, request.lux, model, Path(made)))
    if problems:
        raise UsageError.of(problems)
    seeds = range(request.seed, request.seed + request.repeat)
    rules = cast(tuple[Rule, ...], _once(request.rules) or RULES)
    own = tuple(None if air == OWN else air for air in airs)
    asked = ComparisonPlan(scenes, own, list(dict.fromkeys(times_s)), rules, request.rows, request.lux, seeds)
    return loaded, ways, asked


def _settings(config: RigConfig, asked: ComparisonPlan) -> dict[str, Any]:
    """The request of a comparison, by the names of a `StrategiesRequest`, so that it can be repeated."""
    return {
        "config": config.name,
        "scenes": list(asked.scenes.values()),
        "fogs": [OWN if air is None else air for air in asked.airs],
        "times": [f"{1e3 * time_s:g} ms" for time_s in asked.times_s],
        "rules": list(asked.rules),
        "rows": asked.rows,
        "lux": asked.lux,
        "repeat": len(asked.seeds),
        "seed": asked.seeds.start,
    }


def _once(given: Sequence[str]) -> tuple[str, ...]:
    """The given values in their order, without repetitions."""
    return tuple(dict.fromkeys(given))


def _of_rig_and_request(config: Any, request: StrategiesRequest) -> list[str]:
    """Problems with a rig and options; the names of strategies, air and times apart."""
    problems = []
    if config.world is None or config.world.real_time:
        problems.append(
            f"{config.name} is no simulated rig that keeps its own time; name one that does, such as '{SIMULATED}'"
        )
    if len(config.line_offsets) > 1:
        problems.append(f"{config.name} has {len(config.line_offsets)} lines; name a rig with one, '{SIMULATED}'")
    if config.scan.columns < LINES:
        problems.append(f"scan.columns is {config.scan.columns}; ways to measure depth need at least {LINES}")
    own = {each.name for each in fields(StrategiesRequest)} - {each.name for each in fields(TradeoffRequest)}
    for each in fields(StrategiesRequest):
        if each.name not in own and each.name not in SHARED and getattr(request, each.name) not in (each.default, []):
            problems.append(f"`{each.name}` says nothing with `strategies`; leave one of them out")
    problems += [
        f"`rules` has {rule!r}; the rules are {' and '.join(RULES)}" for rule in request.rules if rule not in RULES
    ]
    if request.rows < 1:
        problems.append(f"`rows` is {request.rows}; at least one row is measured")
    if request.lux is not None and not 0 <= request.lux <= 1e6:
        problems.append(f"`lux` is {request.lux:g}; ambient light is 0 to 1e6 lux")
    if request.repeat < 1:
        problems.append(f"`repeat` is {request.repeat}; it must be at least 1")
    if not 0 <= request.seed <= MAX_SEED - request.repeat:
        problems.append(f"`seed` is {request.seed}; it must be 0 or more and at most {MAX_SEED - request.repeat}")
    return problems
