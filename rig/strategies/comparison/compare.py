"""Measures the same scenes with every strategy (a way to measure depth), and tabulates the results.

Every measurement has the same camera, the same power of its source, the same ambient light and the same time. Each is
repeated with every seed. A seed decides counts and noise; surfaces, drops and hot pixels stay as they are. A row of the
table is one strategy in one scene and air, with one rule and time.
"""

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from rig.batch.case import Case, Result, files_of
from rig.batch.here import do_here
from rig.config.files import portable_content
from rig.config.models import RigConfig
from rig.errors import RigError
from rig.progress import tell_stage
from rig.simd import Float32, Float64
from rig.strategies.apparatus import Budget, Rule, Spent
from rig.strategies.comparison.compute_clock import computing
from rig.strategies.comparison.eye_safety import VISIBLE_M, Field, LaserClass, class_of
from rig.strategies.comparison.places import OWN, scene_path, visibility_m
from rig.strategies.comparison.scene import OpenScene, Place, close_scene, open_scene
from rig.strategies.comparison.score import Score, score
from rig.strategies.strategy import GOOD, Answer, ColumnGeometry, Light, Strategy, TooShort, find_strategy

OVERSPENT: Final = 1e-6
"""Share by which a measurement may exceed its time, because of rounding."""
REACHED: Final = 0.9
"""Share of a distance's pixels that must be good for the distance to be reached."""
BINS_PER_E: Final = 10.0
"""Bins of distance, per factor of e: 10 % wide."""
FEWEST: Final = 30
"""Least number of pixels in a bin of distance; a bin with fewer is not used."""
PULSE_S: Final = 5e-10
"""Length of a flash, for its laser class only; the class is the same for 10 ps to 5 us."""
GREEN_M: Final = 520e-9
WIDE_FAN_RAD: Final = math.radians(50)

PROTECTED: Final = "simulation for comparison only"
"""Words in the sentence of a strategy whose patterns others have protected; the sentence is shown when it runs."""


@dataclass(frozen=True, slots=True)
class ComparisonPlan:
    """Scenes, air, times and rules of a comparison.

    scenes: bundled names, files or folders, by the names that they have in the table. airs: fog, rain, snow or clear
    air; None for a scene's own. times_s: time of a measurement. rules: how the columns that are lit share the light
    (`rig.strategies.apparatus.Rule`). rows: number of image rows, from the middle of the picture. lux: ambient light;
    None for each scene's own. seeds: one measurement with each.
    """

    scenes: Mapping[str, str]
    airs: Sequence[str | None]
    times_s: Sequence[float]
    rules: Sequence[Rule]
    rows: int
    lux: float | None
    seeds: range


@dataclass(frozen=True, slots=True)
class StrategyRow:
    """One strategy in one scene and air, by one rule, within one time; means over all seeds.

    air: a visibility such as 20m, or clear, rain or snow; None for the scene's own. rule: as in `ComparisonPlan`.
    mean_px, median_px, good, valid, confident_wrong: as in `Score`; None if the strategy needs more time. `too_short`
    then says how much. spread_px: standard deviation of mean_px over the seeds, None for one seed. median_mm: median
    depth error. range_m: farthest distance at which 90 % of the pixels are within 2 % of the depth, None if there is
    none. spent_ms: sensor time. energy_mj: energy of the light. compute_s: computing time, simulation included,
    without compiling.
    laser_class: class of the source while it works; laser_class_still: its class if it stood still. Both are None
    without a source, or if its light is not visible.
    """

    strategy: str
    light: Light
    scene: str
    air: str | None
    rule: Rule
    time_ms: float
    pixels: int
    mean_px: float | None = None
    spread_px: float | None = None
    median_px: float | None = None
    median_mm: float | None = None
    good: float | None = None
    valid: float | None = None
    confident_wrong: float | None = None
    range_m: float | None = None
    spent_ms: float | None = None
    energy_mj: float | None = None
    compute_s: float = 0.0
    laser_class: LaserClass | None = None
    laser_class_still: LaserClass | None = None
    too_short: str | None = None


@dataclass(frozen=True, slots=True)
class Comparison:
    """Result of a comparison.

    rows: the complete rows. verdict: 'aborted' if an interrupt ended it. sentences: what each strategy does, by its
    name. notes: lines that must be shown with the result. folder: where it was written.
    """

    rows: tuple[StrategyRow, ...]
    sentences: Mapping[str, str]
    notes: tuple[str, ...]
    verdict: Literal["complete", "aborted"]
    folder: Path | None = None

    @property
    def seconds(self) -> dict[str, dict[str, float]]:
        """Computing time in seconds, by strategy and scene."""
        found: dict[str, dict[str, float]] = {}
        for row in self.rows:
            of = found.setdefault(row.strategy, {})
            of[row.scene] = of.get(row.scene, 0.0) + row.compute_s
        return found

    def as_json(self) -> dict[str, Any]:
        """The result as plain values."""
        return {
            "rows": [asdict(row) for row in self.rows],
            "strategies": dict(self.sentences),
            "notes": list(self.notes),
            "seconds": self.seconds,
            "verdict": self.verdict,
        }


def run_comparison(
    config: RigConfig,
    ways: Sequence[Strategy],
    asked: ComparisonPlan,
    progress: Callable[[int, int], None] | None = None,
) -> Comparison:
    """Measure everything that is `asked` with all strategies, in this process, and tabulate.

    progress: called with the number of measurements done and the total.

    Raises UsageError if a scene cannot be used, and RigError if a strategy takes more time than it has. After an
    interrupt the complete rows are returned; if there is none, the interrupt is raised again.
    """
    try:
        found, aborted = do_here(cases_of(config, ways, asked), "measurement", progress)
    finally:
        close_scene()
    done = tabulate(ways, found, "aborted" if aborted else "complete")
    if not done.rows:
        raise KeyboardInterrupt
    return done


def cases_of(config: RigConfig, ways: Sequence[Strategy], asked: ComparisonPlan) -> list[Case]:
    """A case for each row, in the table's order."""
    content = portable_content(config)
    cases = []
    for (name, scene), air in product(asked.scenes.items(), asked.airs):
        file = scene_path(scene)
        place = asdict(Place(name, file, air, asked.rows, asked.lux))
        files = files_of(content, file)
        for rule, time_s, way in product(asked.rules, asked.times_s, ways):
            labels = {
                "scene": scene, "fog": OWN if air is None else air, "rule": rule, "time": time_s, "strategy": way.name
            }  # fmt: skip
            inputs = {"config": content, "place": place, "way": way.name, "rule": rule, "time_s": time_s,
                      "seeds": [asked.seeds.start, asked.seeds.stop]}  # fmt: skip
            cases.append(Case(f"{__name__}:measure_once", inputs, labels, files))
    return cases


def measure_once(
    config: Mapping[str, Any], place: Mapping[str, Any], way: str, rule: Rule, time_s: float, seeds: tuple[int, int]
) -> dict[str, Any]:
    """One row of a comparison, for a case of `cases_of`: plain values, with the computing time apart. place: fields of
    `Place`. way: name of the strategy. seeds: the first, and the last plus one."""
    row = _measured(open_scene(config, Place(**place)), find_strategy(way), rule, time_s, range(*seeds))
    content = asdict(row)
    compute_s = content.pop("compute_s")
    return {"rows": [content], "measured": {"compute_s": [compute_s]}}


def tabulate(
    ways: Sequence[Strategy], found: Sequence[Result | None], verdict: Literal["complete", "aborted"] = "complete"
) -> Comparison:
    """Make the comparison from the results of the cases of `cases_of`, in their order; missing ones (None) are left
    out."""
    rows = tuple(
        StrategyRow(**{**row, "compute_s": compute_s})
        for result in found
        if result is not None
        for row, compute_s in zip(result["rows"], result["measured"]["compute_s"], strict=True)
    )
    return Comparison(rows, {way.name: way.sentence for way in ways}, notes_of(ways), verdict)


def notes_of(ways: Iterable[Strategy]) -> tuple[str, ...]:
    """Lines that must be shown with results of these strategies: that the patterns of some are protected."""
    return tuple(dict.fromkeys(f"{way.name}: {way.sentence}" for way in ways if PROTECTED in way.sentence))


def _measured(scene: OpenScene, way: Strategy, rule: Rule, time_s: float, seeds: range) -> StrategyRow:
    """The row of a strategy before a scene."""
    place = scene.place
    within = "the scene's own air" if place.air is None else place.air
    tell_stage(f"{way.name}, {place.name}, {within}, {time_s * 1e3:g} ms")
    row = StrategyRow(way.name, way.light, place.name, place.air, rule, 1e3 * time_s, len(scene.true_m))
    classes = _classes(scene.config, scene.geometry, way.light, scene.power_w, rule, time_s)
    row = replace(row, laser_class=classes[0], laser_class_still=classes[1])
    scores: list[Score] = []
    reached = Reached(scene.true_m)
    spent: list[tuple[float, float]] = []
    with computing() as compute_s:
        try:
            for seed in seeds:
                answer, used = _measure(scene, way, rule, time_s, seed)
                spent.append((used.time_s, used.energy_j))
                scores.append(score(answer, scene.truth, scene.geometry, scene.scored))
                reached.add(answer.depth_m[scene.scored])
        except TooShort as why:
            return replace(row, too_short=str(why), compute_s=compute_s())
        spent_ms, energy_mj = (1e3 * statistics.fmean(each) for each in zip(*spent, strict=True))
        row = replace(row, **_means(scores), range_m=reached.range_m(), spent_ms=spent_ms, energy_mj=energy_mj)
        return replace(row, compute_s=compute_s())


def _measure(scene: OpenScene, way: Strategy, rule: Rule, time_s: float, seed: int) -> tuple[Answer, Spent]:
    """A strategy's answer, and the time and energy that it took. Raises RigError if that is more than it had."""
    apparatus = scene.apparatus(rule, seed)
    try:
        answer = way.measure(apparatus, scene.geometry, Budget(time_s), seed)
    except (TooShort, RigError):
        raise
    except Exception as error:
        error.add_note(f"raised by the strategy {way.name} in {time_s * 1e3:g} ms: tell its authors")
        raise
    require_form(answer, way.name, scene.geometry.shape)
    spent = apparatus.spent
    if spent.time_s > time_s * (1 + OVERSPENT):
        raise RigError(f"{way.name} took {spent.time_s * 1e3:g} ms of {time_s * 1e3:g} ms; correct the strategy")
    return answer, spent


def require_form(answer: Answer, name: str, shape: tuple[int, int]) -> None:
    """Raise RigError, one line, if a strategy's answer is not what `Answer` says. shape: (rows, width)."""
    if not isinstance(answer, Answer):
        raise RigError(f"{name} answers with {type(answer).__name__}; it must return a rig.strategies.strategy.Answer")
    for field, values in (("depth_m", answer.depth_m), ("confidence", answer.confidence)):
        if np.shape(values) != shape or np.asarray(values).dtype != np.float32:
            raise RigError(
                f"{name} answers with a {field} of {np.asarray(values).dtype} and shape {np.shape(values)}; "
                f"it must be float32 (rows, width) = {shape}, for the rows that were measured"
            )
    given = np.isfinite(answer.depth_m)
    if not np.all((answer.confidence >= 0) & (answer.confidence <= 1)) or np.any(answer.confidence[~given] != 0):
        raise RigError(f"{name} has a confidence that is not 0 to 1, or not 0 where depth_m is NaN; correct it")


def _means(scores: Sequence[Score]) -> dict[str, Any]:
    """Fields of a row from the scores of all seeds."""
    medians = [each.median_px for each in scores if each.median_px is not None]
    metres = [each.median_m for each in scores if each.median_m is not None]
    means = [each.mean_px for each in scores]
    return {
        "mean_px": statistics.fmean(means),
        "spread_px": statistics.stdev(means) if len(means) > 1 else None,
        "median_px": statistics.fmean(medians) if medians else None,
        "median_mm": 1e3 * statistics.fmean(metres) if metres else None,
        "good": statistics.fmean(each.good for each in scores),
        "valid": statistics.fmean(each.valid for each in scores),
        "confident_wrong": statistics.fmean(each.confident_wrong for each in scores),
    }


class Reached:
    """Counts good answers by distance. true_m: (pixels,), depth of all scored pixels."""

    def __init__(self, true_m: Float32) -> None:
        self._true_m = true_m.astype(np.float64)
        self._bin = np.floor(BINS_PER_E * np.log(self._true_m)).astype(np.int64)
        self._bin -= self._bin.min()
        self._good = np.zeros(int(self._bin.max()) + 1)
        self._all = np.zeros_like(self._good)

    def add(self, depth_m: Float32) -> None:
        """Add an answer's depths (pixels,), NaN where there is none."""
        with np.errstate(invalid="ignore"):
            good = np.abs(depth_m - self._true_m) <= GOOD * self._true_m
        self._good += np.bincount(self._bin, weights=good, minlength=len(self._good))
        self._all += np.bincount(self._bin, minlength=len(self._all))

    def range_m(self) -> float | None:
        """Largest depth in the farthest bin of which at least the share REACHED is good; None if there is none. Bins
        with fewer than FEWEST pixels are left out."""
        counts = np.bincount(self._bin, minlength=len(self._all)) >= FEWEST
        far = np.flatnonzero(counts & (self._good >= REACHED * np.maximum(self._all, 1)))
        return float(self._true_m[self._bin == far[-1]].max()) if len(far) else None


def _classes(
    config: RigConfig, geometry: ColumnGeometry, light: Light, power_w: float, rule: Rule, time_s: float
) -> tuple[LaserClass | None, LaserClass | None]:
    """Laser classes of a source while it works, and if it stood still; None without one, or for invisible light."""
    if light == "ambient":
        return None, None
    line: Any = getattr(config.world, "line", None)
    wavelength_m = float(getattr(line, "wavelength", GREEN_M))
    if not VISIBLE_M[0] <= wavelength_m <= VISIBLE_M[1]:
        return None, None
    fan_rad = float(getattr(line, "fan", WIDE_FAN_RAD))
    normals: Float64 = geometry.model.planes(geometry.commands[[0, -1]])[:, :3]
    scan_rad = math.acos(min(1.0, abs(float(normals[0] @ normals[1]))))
    height = geometry.model.camera.height
    if rule == "irradiance":  # a pattern lights half of the columns with the whole power
        lit = {"line": 1.0, "spot": 1 / height, "flash": float(geometry.columns)}
        power_w *= lit.get(light, geometry.columns / 2) / (geometry.columns / 2)
    field = Field(power_w, fan_rad, scan_rad)
    beams = {
        "spot": field.spot(time_s, height),
        "line": field.line(time_s),
        "pattern": field.pattern(),
        "flash": field.flash(PULSE_S, float(config.scan.frame_rate)),
    }[light]
    return class_of(beams[0], wavelength_m), class_of(beams[1], wavelength_m)


def ranges(rows: Sequence[StrategyRow], scene: str) -> dict[tuple[str, float, Rule], dict[str, float | None]]:
    """Range in metres by (strategy, time in ms, rule) and air, in one scene, for air with a known visibility."""
    found: dict[tuple[str, float, Rule], dict[str, float | None]] = {}
    for row in rows:
        if row.scene == scene and row.air is not None and visibility_m(row.air) is not None and row.too_short is None:
            found.setdefault((row.strategy, row.time_ms, row.rule), {})[row.air] = row.range_m
    return found
