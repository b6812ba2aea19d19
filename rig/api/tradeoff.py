"""The call that tries settings on a simulated rig: `tradeoff`."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from rig.config.models import RigConfig
from rig.config.overrides import MAX_SEED, SIMULATED, Config, configure
from rig.errors import UsageError
from rig.progress import Progress
from rig.scan.run import OutFolder

if TYPE_CHECKING:
    from rig.tradeoff.trials import Tradeoff

EXPOSURES = (1, 3, 10)
"""Exposures per column that are tried where the caller names none."""


def tradeoff(
    config: Config = SIMULATED,
    *,
    scenes: Sequence[str] = (),
    fogs: Sequence[str] = (),
    exposures: Sequence[int] = (),
    lines: Sequence[int] = (),
    estimators: Sequence[str] = (),
    filters: Sequence[str] = (),
    repeat: int = 1,
    seed: int = 0,
    limits: bool = True,
    time_budget: str | None = None,
    error: str | None = None,
    of: str = "sensor",
    accept_calibration: bool = False,
    out: OutFolder = None,
    progress: Progress | None = None,
) -> "Tradeoff":
    """Scan a simulated rig with all combinations of settings and score them by the world's truth (`rig tradeoff`).

    scenes: as in `configure`. fogs: visibilities such as '20 m', or 'clear'. lines: numbers of lines at once. Where one
      of these is empty, the config decides.
    exposures: exposures per column; empty is EXPOSURES.
    estimators: empty is all but argmax. filters: empty is all.
    repeat: scans of each setting, with seeds from `seed` on.
    limits: compare each error with the least that the light of the scene allows; takes some seconds each.
    time_budget, error: ask which setting to use within a time such as '5 ms', or for an error such as '0.1 px'.
    of: whose time counts, 'sensor' or 'compute'.
    accept_calibration: as in `scan`, judged for the rig with the number of lines that its config has.
    out: folder to write; None writes nothing.
    progress: called with frames done and frames to do.

    Raises UsageError, one line per problem. An interrupt ends it after the last whole row, with verdict 'aborted'.
    """
    from rig.config.models import with_lines
    from rig.devices.calibration_use import accepted_by, calibration_use
    from rig.devices.open import open_rig
    from rig.estimate.registry import ESTIMATORS, FILTERS
    from rig.run_folder.folder import RunFolder
    from rig.tradeoff.choice import wish_of
    from rig.tradeoff.files import write_files
    from rig.tradeoff.trials import Trial, Trials, require_methods, run_tradeoff

    loaded = configure(config)
    problems = _of_rig(loaded)
    estimators = estimators or [name for name in ESTIMATORS if name != "argmax"]
    filters = filters or FILTERS
    problems += require_methods(estimators, filters)
    if loaded.estimate.temporal_prior and set(estimators) != {"joint"}:
        problems.append(
            f"{loaded.name} has estimate.temporal_prior, which is for joint alone; leave it out of the config or try "
            "--estimators joint"
        )
    if repeat < 1:
        problems.append(f"repeat is {repeat}; it must be at least 1")
    if not 0 <= seed <= MAX_SEED - repeat:
        problems.append(f"seed is {seed}; it must be 0 or more and at most {MAX_SEED - repeat}")
    wish = None
    try:
        wish = wish_of(time_budget, error, of)
    except UsageError as wrong:
        problems += wrong.problems
    if problems:
        raise UsageError.of(problems)

    def config_of(trial: Trial) -> RigConfig:
        tried = configure(config, scene=trial.scene, fog=trial.fog, exposures=trial.exposures)
        return tried if trial.lines is None else with_lines(tried, trial.lines)

    trials = Trials(
        config_of,
        scenes or (None,),
        fogs or (None,),
        exposures or EXPOSURES,
        lines or (None,),
        estimators,
        filters,
        repeat,
        seed,
        limits,
    )
    trials.require_plans()  # before a folder is claimed
    with open_rig(config_of(trials.first())) as rig:
        accepted = accepted_by(calibration_use(rig, accept=accept_calibration))

    def run() -> "Tradeoff":
        return replace(run_tradeoff(trials, wish, progress), accepted_calibration=accepted)

    if out is None:
        return run()
    with RunFolder(out) as folder:
        done = run()
        chosen = None
        if done.answer is not None and done.answer.fits:
            setting = done.answer.setting
            trial = Trial(trials.scenes[0], trials.fogs[0], setting.exposures, setting.lines if lines else None)
            chosen = configure(config_of(trial), estimator=setting.estimator, filter=setting.filter)  # type: ignore[arg-type]
        return write_files(folder, done, chosen)


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
