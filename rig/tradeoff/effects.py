"""Lists the effects that a simulated scene calls for, as its world reports them, and measures how much each matters."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceError
from drivers.interfaces import World
from drivers.registry import lookup
from rig.config.models import RigConfig
from rig.config.overrides import SIMULATED, Config, configure
from rig.devices.open import DEVICES, open_rig, surroundings_of
from rig.errors import PlanError, UsageError
from rig.geometry.line_grid import line_grid
from rig.geometry.stripe_table import MISSING_PX, charged_errors
from rig.plan.scan_plan import column_command
from rig.progress import Progress, part, tell_stage
from rig.requests import RunRequest
from rig.run_folder.summary import MapTally
from rig.scan.run import Run
from rig.scan.scan import run_scan

Array = NDArray[np.float64]
Flux = dict[str, NDArray[Any]]
"""Arrays (width,): x_px, total, and the parts of the total by effect, in photons per exposure."""

TRIAL_COLUMNS = 40
"""Columns of a trial scan, spread over the config's range: some 10^4 stripes."""


@runtime_checkable
class ReportsEffects(World, Protocol):
    """A world that can report how much its effects matter."""

    def effects_report(self, power_w: float, exposure_s: float, exposures: int) -> Mapping[str, Any]:
        """A report with the fields of `SceneEffects`; its `effects` are mappings, one for each effect.

        A mapping's keys are the fields of `Effect` up to `cost_us_per_frame`, and `removable`: whether the effect can
        be left out with `effects` in the world's config.
        """
        ...

    def plan_for(self, power_w: float, exposure_s: float, exposures: int) -> None:
        """Choose the simulated effects for columns of `exposures` frames, each exposed for `exposure_s`, at
        `power_w`."""
        ...

    def flux_row(self, row: int, command: float, power_w: float, exposure_s: float) -> Mapping[str, Array]:
        """Photons per exposure of an image row with the mirror at a command, (width,) for each effect."""
        ...

    @property
    def size(self) -> tuple[int, int]:
        """Number of rows, and width in pixels."""
        ...


@dataclass(frozen=True, slots=True)
class Effect:
    """One effect in one scene.

    on, why: whether it is simulated, and the reason.
    share: share of all detected photons.
    changed_decisions_bound: largest share of an estimator's answers that can differ without the effect, whatever the
      estimator; None if there is no bound.
    cost_us_per_frame: computing time on one thread; None if it is part of another effect.
    stripe_error_change_px, stripe_error_change_sd_px: how much larger the mean stripe error is with the effect than
      without it, and the standard error of this change; None if not known.
    basis: 'trial' if the change was measured in a pair of trial scans, 'bound' if it is the bound of an effect that is
      left out.
    """

    effect: str
    on: bool
    why: str
    share: float
    changed_decisions_bound: float | None
    cost_us_per_frame: float | None
    stripe_error_change_px: float | None = None
    stripe_error_change_sd_px: float | None = None
    basis: Literal["trial", "bound"] | None = None


@dataclass(frozen=True, slots=True)
class SceneEffects:
    """The effects of a scene.

    planned_for: the largest values for which the choice of effects holds: power_w of all lines together, exposure_s of
      a column's frames together, and exposures, the number of these frames, which may be one more than planned.
    changed_decisions_bound: largest share of an estimator's answers, 0 to 1, that all effects left out can
      change together.
    """

    planned_for: Mapping[str, float]
    changed_decisions_bound: float
    effects: tuple[Effect, ...]

    def __iter__(self) -> Iterator[Effect]:
        """The effects."""
        return iter(self.effects)


def scene_effects(
    config: Config = SIMULATED, *, scene: str | None = None, trials: bool = True, progress: Progress | None = None
) -> SceneEffects:
    """List the physical effects that a simulated scene calls for, why, and how much each matters (`rig effects`).

    They are judged at the power, exposure time and number of exposures of the config's scan.
    trials: measure how much each effect changes the stripe error, in pairs of short scans; takes seconds.
    progress: called with the number of trial scans done and the total.
    Raises UsageError without a simulated world.
    """
    config = configure(config, scene=scene)
    scan = config.scan
    with open_world(config) as (world, power_w):
        report = world.effects_report(power_w, scan.exposure_s, scan.exposures)
    lines = list(report["effects"])
    removable = [line.pop("removable") for line in lines]
    effects = [Effect(**line) for line in lines]
    if trials:
        on = [effect.effect for effect in effects if effect.on]
        tried = [e.effect for e, can in zip(effects, removable, strict=True) if e.on and can]
        changes = _trials(config, on, tried, progress)
        effects = [_with_change(effect, changes) for effect in effects]
    return SceneEffects(report["planned_for"], report["changed_decisions_bound"], tuple(effects))


def flux_row(config: Config = SIMULATED, *, scene: str | None = None, row: int | None, column: int | None) -> Flux:
    """Noise-free photons per exposure of one image row while the line is at a column's centre (`rig effects --row`).

    Returns x_px: pixels (width,); total: photons of each; and by its name the part of each effect of light or dark
    counts, zeros for an effect that is off. The parts add up to the total. Raises UsageError for a row or column that
    does not exist.
    """
    if row is None or column is None:
        raise UsageError("the flux is that of one image row at one column of the scan; give both `row` and `column`")
    config = configure(config, scene=scene)
    scan = config.scan
    tell_stage("making the scene")
    with open_world(config) as (world, power_w):
        rows, width = world.size
        problems = [
            f"{name} is {value}; the {whole} has {name}s 0 to {count - 1}"
            for name, value, whole, count in (("row", row, "camera", rows), ("column", column, "scan", scan.columns))
            if not 0 <= value < count
        ]
        if problems:
            raise UsageError.of(problems)
        command = _mirror_command(config, column)
        parts = world.flux_row(row, command, power_w, scan.exposure_s)
    return {"x_px": np.arange(width), "total": sum(parts.values(), np.zeros(width)), **parts}


def _mirror_command(config: RigConfig, column: int) -> float:
    """The mirror command at a column's centre."""
    scan, offsets = config.scan, config.line_offsets
    if len(offsets) > 1:
        grid, _ = line_grid(offsets, scan.columns, scan.command_range)
        column = int(grid.place[column])
    return float(column_command(column, scan.command_range, scan.columns // len(offsets)))


@contextmanager
def open_world(config: RigConfig) -> Iterator[tuple[ReportsEffects, float]]:
    """Open the config's world with its simulated devices, planned for its scan; also gives the scan's power in W.
    Raises UsageError if there is no world or power, or if the world cannot be made or does not report effects."""
    if config.world is None:
        raise UsageError(f"{config.name} has no simulated world; name a config that has one, such as 'simulated'")
    with ExitStack() as stack:
        try:
            surroundings = surroundings_of(config, 0, stack)
        except DeviceError as error:  # a missing scene is an error of the config
            raise UsageError(f"world: {error}") from error
        world: Any = surroundings.world
        if not isinstance(world, ReportsEffects):
            raise UsageError(f"world {config.world.kind} says nothing of its effects")
        for slot in DEVICES:
            device = getattr(config, slot)
            if not device.real_time:  # a simulated one tells the world what it does
                stack.enter_context(lookup(slot, device.kind).create(device, surroundings))
        # As in a scan: the laser's limit, which its config states even if the laser is not opened here. A laser that is
        # set by hand states its power itself.
        limit_w = getattr(config.laser, "power", getattr(config.laser, "max_power", None))
        power_w = limit_w if config.scan.power is None else config.scan.power
        if power_w is None:
            raise UsageError(f"{config.name} states no laser power; add for example 'power: 20 mW' under scan")
        world.plan_for(power_w, config.scan.exposure_s, config.scan.exposures)
        yield world, power_w


def _trials(
    config: RigConfig, on: list[str], tried: list[str], progress: Progress | None
) -> dict[str, tuple[float, float]]:
    """Pixels by which the mean stripe error grows with each effect, and the standard error of this growth.

    Measured in pairs of short scans with the same random numbers and all other effects on. Empty for a world that runs
    in real time.
    """
    if config.world is None or config.world.real_time:
        return {}
    columns = min(TRIAL_COLUMNS - TRIAL_COLUMNS % -len(config.line_offsets), config.scan.columns)
    trials = 1 + len(tried)
    while True:
        try:
            with part(f"trial scan 1 of {trials}"):
                whole = _trial(config, columns, on)
            break
        except PlanError:  # the mirror cannot sweep so fast
            if columns == config.scan.columns:
                raise
            columns = min(2 * columns, config.scan.columns)
    changes = {}
    for done, name in enumerate(tried, 1):
        if progress is not None:
            progress(done, trials)
        with part(f"trial scan {done + 1} of {trials}"):
            change = whole - _trial(config, columns, [other for other in on if other != name])
        per_column = [float(np.nanmean(each)) for each in change.T if np.isfinite(each).any()]
        if per_column:
            spread = float(np.std(per_column, ddof=1)) if len(per_column) > 1 else float("nan")
            changes[name] = float(np.nanmean(change)), spread / len(per_column) ** 0.5
    return changes


def _trial(config: RigConfig, columns: int, names: list[str]) -> Array:
    """Stripe errors (rows, columns) in px of a scan of this many columns with these effects, see `charged_errors`.

    An interrupt is raised again.
    """
    assert config.world is not None, "there was a report"
    world = config.world.model_copy(update={"effects": tuple(names)})
    short = config.scan.model_copy(update={"columns": columns})
    settings = config.model_copy(update={"world": world, "scan": short})
    tally = MapTally(columns, short.exposures, settings.estimate.estimator, settings.estimate.filter)
    with Run(None, tally) as run, open_rig(settings) as rig:
        result = run_scan(rig, run, RunRequest()).uninterrupted()
    last, truth = result.last, result.truth
    assert last is not None, "one map was asked for"
    assert truth is not None, "worlds know it"
    return charged_errors(last.stripe.x_px, truth.x_px)


def _with_change(effect: Effect, changes: Mapping[str, tuple[float, float]]) -> Effect:
    if effect.effect in changes:
        change, sd = changes[effect.effect]
        return replace(effect, stripe_error_change_px=change, stripe_error_change_sd_px=sd, basis="trial")
    if not effect.on and effect.changed_decisions_bound is not None:
        most_px = MISSING_PX * effect.changed_decisions_bound
        return replace(effect, stripe_error_change_px=most_px, basis="bound")
    return effect
