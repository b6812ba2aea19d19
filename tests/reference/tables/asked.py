"""Every figure that is asked of the accuracy of `joint`, from the answers of many maps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from tests.reference.tables.answers import Answers, calibration_error, pooled

REPORT_PX = {1: (0.4, 0.5), 3: (0.25, 0.35), 10: (0.14, 0.25), 20: (0.10, 0.15)}
"""Most mean error over scenes, and on the worst of them, by exposures."""
MISSING = 0.05
BOUND_TIMES = 1.5
CALIBRATION = 0.03
THIN_WITHIN = 0.8
"""Of the stripes on a thin object, the share within 1 px from which it counts as still there (our own figure)."""


@dataclass(frozen=True, slots=True)
class Measured:
    """Answers of one estimator on one scene. extras: figures of a made scene by name."""

    point: str
    scene: str
    exposures: int
    estimator: str
    answers: Answers
    extras: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing asked and what came out; mean and worst as text."""

    what: str
    exposures: str
    estimator: str
    asked: str
    mean: str
    worst: str
    verdict: str


Group = dict[str, Measured]
"""What one estimator gave at one point and number of exposures, by scene."""


def findings(measured: Sequence[Measured]) -> list[Finding]:
    """Everything asked that these answers can tell, estimator after estimator."""
    out: list[Finding] = []
    for estimator in dict.fromkeys(one.estimator for one in measured):
        groups: dict[tuple[str, int], Group] = {}
        for one in measured:
            if one.estimator == estimator:
                groups.setdefault((one.point, one.exposures), {})[one.scene] = one
        for what in (_report, _dense, _clear, _halo, _hot, _extras, _calibration):
            out.extend(what(estimator, groups))
    return out


Groups = dict[tuple[str, int], Group]


def _report(estimator: str, groups: Groups) -> Iterator[Finding]:
    for (point, k), group in sorted(groups.items()):
        if point == "report":
            asked = REPORT_PX.get(k)
            yield _most("report: mean error, px", k, estimator, group, lambda a: a.mean_px, asked)
            least = 0.97 if k == 3 else None
            yield _least("report: within 1 px", k, estimator, _by_scene(group, lambda a: a.within), least)


def _dense(estimator: str, groups: Groups) -> Iterator[Finding]:
    for (point, k), group in sorted(groups.items()):
        if point == "dense":
            yield _most(
                "dense: mean error, px", k, estimator, group, lambda a: a.mean_px, (0.5, None) if k == 3 else None
            )


def _clear(estimator: str, groups: Groups) -> Iterator[Finding]:
    for (point, k), group in sorted(groups.items()):
        if point != "clear":
            continue
        most, most_sure = ((0.8, None), (0.15, None)) if k == 1 else (None, None)
        name = "clear: mean error, px, "
        yield _most(name + "all stripes", k, estimator, group, lambda a: a.over(a.lit).mean_px, most)
        yield _most(name + "all trusted", k, estimator, group, lambda a: a.mean_px, most)
        surest = "95 % most confident of "
        yield _most(name + surest + "all", k, estimator, group, lambda a: a.over(a.lit).surest(0.95), most_sure)
        yield _most(name + surest + "trusted", k, estimator, group, lambda a: a.surest(0.95), most_sure)


def _halo(estimator: str, groups: Groups) -> Iterator[Finding]:
    for (point, k), group in sorted(groups.items()):
        if point != "halo":
            continue
        yield _most("halo: mean error, px", k, estimator, group, lambda a: a.mean_px, (1.0, None) if k == 5 else None)
        bias = _by_scene(group, lambda a: a.bias_px)
        yield _bias("halo: bias, px", k, estimator, bias)
        without = groups.get(("halo-less", k), {})
        if shared := [name for name in bias if name in without]:
            there = {name: bias[name] - without[name].answers.bias_px for name in shared}
            yield _bias("halo: bias over that without halo, px", k, estimator, there)


def _hot(estimator: str, groups: Groups) -> Iterator[Finding]:
    for (point, k), group in sorted(groups.items()):
        if point != "hot":
            continue
        clean = groups.get(("report", k), {})
        if shared := [name for name in group if name in clean]:
            mean = [float(np.mean([g[n].answers.mean_px for n in shared])) for g in (group, clean)]
            ratios = {n: group[n].answers.mean_px / clean[n].answers.mean_px for n in shared}
            worst = max(ratios, key=ratios.__getitem__)
            yield _finding(
                "hot pixels 1 %: error over that without", k, estimator, "at most 1.05", mean[0] / mean[1],
                f"{ratios[worst]:.3f} ({worst})", mean[0] / mean[1] <= 1.05,
            )  # fmt: skip


def _extras(estimator: str, groups: Groups) -> Iterator[Finding]:
    for (point, k), group in sorted(groups.items()):
        for one in group.values():
            of = f"{point}, {one.scene}" if one.scene != point else point
            for name, value in one.extras.items():
                if "times the bound" in name:
                    yield _finding(
                        f"{of}: {name}", k, estimator, f"at most {BOUND_TIMES}", value, "", value <= BOUND_TIMES
                    )
                elif name.startswith(("pole", "fence")):
                    yield _finding(
                        f"{of}: {name}", k, estimator, f"at least {THIN_WITHIN}", value, "", value >= THIN_WITHIN
                    )
                else:
                    yield _finding(f"{of}: {name}", k, estimator, "", value, "", None)


def _calibration(estimator: str, groups: Groups) -> Iterator[Finding]:
    everything: list[Answers] = []
    for (point, k), group in sorted(groups.items()):
        answers = pooled([one.answers for one in group.values()])
        everything.append(answers)
        yield from _calibration_errors(point, str(k), estimator, answers)
    if everything:
        yield from _calibration_errors("all points", "", estimator, pooled(everything))


def _calibration_errors(what: str, k: str, estimator: str, answers: Answers) -> Iterator[Finding]:
    """Over the scored stripes, and with answers where there is no stripe counted as wrong."""
    for empty, name in ((False, "stripes"), (True, "stripes and rows without")):
        value = calibration_error(*answers.claims(empty=empty))
        holds = value < CALIBRATION
        yield _finding(f"{what}: calibration error, {name}", k, estimator, f"below {CALIBRATION}", value, "", holds)


def _by_scene(group: Group, figure: Callable[[Answers], float]) -> dict[str, float]:
    return {name: figure(one.answers) for name, one in group.items()}


def _most(
    what: str,
    k: int,
    estimator: str,
    group: Group,
    figure: Callable[[Answers], float],
    asked: tuple[float, float | None] | None,
) -> Finding:
    """A figure that is to stay below limits in the mean and on the worst scene, with at most 5 % missing."""
    values = _by_scene(group, figure)
    worst = max(values, key=values.__getitem__)
    mean = float(np.mean(list(values.values())))
    holds = None
    text = ""
    if asked is not None:
        most, most_worst = asked
        text = f"{most:g}" if most_worst is None else f"{most:g}, worst {most_worst:g}"
        holds = mean <= most and (most_worst is None or values[worst] <= most_worst)
        holds = holds and all(one.answers.missing <= MISSING for one in group.values())
    return _finding(what, k, estimator, text, mean, f"{values[worst]:.3f} ({worst})", holds)


def _least(what: str, k: int, estimator: str, values: dict[str, float], asked: float | None) -> Finding:
    worst = min(values, key=values.__getitem__)
    mean = float(np.mean(list(values.values())))
    holds = None if asked is None else mean >= asked
    return _finding(
        what,
        k,
        estimator,
        "" if asked is None else f"at least {asked:g}",
        mean,
        f"{values[worst]:.3f} ({worst})",
        holds,
    )


def _bias(what: str, k: int, estimator: str, values: dict[str, float]) -> Finding:
    worst = max(values, key=lambda name: abs(values[name]))
    mean = float(np.mean(list(values.values())))
    return _finding(
        what, k, estimator, "within 0.1", mean, f"{values[worst]:+.3f} ({worst})", abs(values[worst]) <= 0.1
    )


def _finding(
    what: str, k: int | str, estimator: str, asked: str, value: float, worst: str, holds: bool | None
) -> Finding:
    verdict = "" if holds is None else "pass" if holds else "short"
    return Finding(what, str(k), estimator, asked, f"{value:.4f}", worst, verdict)
