"""The call that tries settings on a simulated rig: `tradeoff`."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from rig.batch.case import Case, Result
from rig.config.models import RigConfig
from rig.config.overrides import MAX_SEED, SIMULATED, Config, configure
from rig.devices.calibration_use import accepted_by, calibration_use
from rig.devices.open import open_rig
from rig.errors import UsageError, noted
from rig.estimate.registry import ESTIMATORS, FILTERS
from rig.interrupts import one_interrupt
from rig.progress import Progress
from rig.requests import TradeoffRequest
from rig.run_folder.folder import RunFolder
from rig.tradeoff.choice import Wish, wish_of
from rig.tradeoff.files import write_files
from rig.tradeoff.trials import (
    Tradeoff,
    Trial,
    Trials,
    cases_of,
    method_problems,
    run_tradeoff,
    tabulate,
    trials_of,
)

WriteResults = Callable[[RunFolder, list[Result | None], bool], object]
"""Writes what is made of the results of cases, None for those that are missing; the bool: whether they were aborted."""
EXPOSURES = (1, 3, 10)
"""Exposures per column that are tried if the caller names none."""


def tradeoff(
    config: Config = SIMULATED,
    request: TradeoffRequest | None = None,
    *,
    progress: Progress | None = None,
    **changes: Any,
) -> Tradeoff:
    """Scan a simulated rig with all combinations of settings and compare the maps with the truth (`rig tradeoff`).

    request, changes: options, as a `TradeoffRequest` or by the names of its fields:
      `tradeoff(exposures=(1, 3), time_budget="20 ms")`. The calibration is checked once, against the rig with as many
      lines as its config names.
    progress: called with the number of scans done and of all.

    Raises UsageError, one line per problem. An interrupt ends the trials after the last complete row, with verdict
    'aborted'.
    """
    request = replace(request or TradeoffRequest(), **changes)
    ready = _prepared(config, request)

    def run() -> Tradeoff:
        done = run_tradeoff(ready.trials, ready.request, ready.wish, progress)
        return replace(done, accepted_calibration=ready.accepted)

    if request.out is None:
        return run()
    with one_interrupt(), RunFolder(request.out) as folder:
        return ready.write(folder, run())


def as_cases(config: Config, request: TradeoffRequest) -> tuple[list[Case], WriteResults]:
    """The scans of a trade-off as cases, and a function that writes the trade-off of their results into a folder.

    The function takes None for a result that is missing. Raises UsageError as `tradeoff` does.
    """
    ready = _prepared(config, request)

    def write(folder: RunFolder, found: list[Result | None], aborted: bool) -> object:
        done = tabulate(ready.trials, ready.request, ready.wish, found, "aborted" if aborted else "complete")
        return ready.write(folder, replace(done, accepted_calibration=ready.accepted)) if done.rows else None

    return cases_of(ready.trials, ready.request), write


@dataclass(frozen=True, slots=True)
class _Prepared:
    """A checked request, with its usual values filled in. first: the first trial, on the config's own lines."""

    config: Config
    request: TradeoffRequest
    wish: Wish | None
    trials: Trials
    first: Trial
    accepted: tuple[str, ...]

    def write(self, folder: RunFolder, done: Tradeoff) -> Tradeoff:
        """Write everything, with the chosen setting as a config."""
        chosen = None
        if done.answer is not None and done.answer.fits:
            setting = done.answer.setting
            lines = setting.lines if self.request.lines else None
            chosen = self.first._replace(exposures=setting.exposures, lines=lines).config(self.config)
            chosen = configure(chosen, estimator=setting.estimator, filter=setting.filter)  # type: ignore[arg-type]
        return write_files(folder, done, chosen)


def _prepared(config: Config, request: TradeoffRequest) -> _Prepared:
    """Check a request. Raises UsageError with all problems."""
    loaded = configure(config)
    problems = _of_rig(loaded)
    request = replace(
        request,
        exposures=request.exposures or EXPOSURES,
        estimators=request.estimators or [name for name in ESTIMATORS if name != "argmax"],
        filters=request.filters or FILTERS,
    )
    problems += method_problems(request.estimators, request.filters)
    if loaded.estimate.temporal_prior and set(request.estimators) != {"joint"}:
        problems.append(
            f"{loaded.name} has estimate.temporal_prior, which is for joint alone; leave it out of the config or try "
            "`estimators=joint`"
        )
    if request.repeat < 1:
        problems.append(f"repeat is {request.repeat}; it must be at least 1")
    most_seed = MAX_SEED - request.repeat
    if not 0 <= request.seed <= most_seed:
        problems.append(f"seed is {request.seed}; it must be 0 or more and at most {most_seed}")
    wish = None
    with noted(problems):
        wish = wish_of(request.time_budget, request.error, request.of)
    if problems:
        raise UsageError.of(problems)

    trials = trials_of(config, request)  # before a folder is claimed
    first = next(iter(trials))._replace(lines=None)
    with open_rig(first.config(config)) as rig:
        accepted = accepted_by(calibration_use(rig, accept=request.accept_calibration))
    return _Prepared(config, request, wish, trials, first, accepted)


def _of_rig(config: RigConfig) -> list[str]:
    """List the problems that keep settings from being tried on this rig."""
    if config.world is None:
        return [f"{config.name} is a real rig, whose truth nobody knows; name a simulated one, such as '{SIMULATED}'"]
    if config.world.real_time:
        return [
            f"{config.name} runs in the host's time, not as fast as it can; name a simulated rig, such as '{SIMULATED}'"
        ]
    if config.calibration is None:
        return [f"{config.name} has no calibration, so no depth; name one in the config"]
    return []
