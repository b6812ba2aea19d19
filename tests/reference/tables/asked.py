"""Every figure that is asked of the accuracy of `joint`, from the answers of many maps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter

import numpy as np

from tests.reference.tables.answers import Answers, calibration_error, pooled

MISSING = 0.05
BOUND_TIMES = 1.5
CALIBRATION = 0.03
HOT_TIMES = 1.05
THIN_WITHIN = 0.8
"""Share of the stripes on a thin object within 1 px from which it counts as still there (our own figure)."""


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
"""Answers of one estimator at one point and number of exposures, by scene."""
Groups = dict[tuple[str, int], Group]

ANY = 0
"""Any number of exposures."""
BAD: Mapping[str, Callable[[float], float]] = {"at most": lambda x: x, "at least": lambda x: -x, "within": abs}
"""Badness of a value, by the sense of its limits."""


@dataclass(frozen=True, slots=True)
class Asked:
    """A figure of the answers on each scene. limits: of the mean over scenes and of the worst one, by exposures."""

    what: str
    figure: Callable[[Answers], float]
    limits: Mapping[int, tuple[float | None, float | None]]
    sense: str = "at most"

    def finding(self, k: int, estimator: str, group: Group, values: Mapping[str, float]) -> Finding:
        """The figure's values by scene beside its limits. An error counts only where few answers are missing."""
        bad = BAD[self.sense]
        worst = max(values, key=lambda name: bad(values[name]))
        mean = float(np.mean(list(values.values())))
        most, most_worst = self.limits.get(k, self.limits.get(ANY, (None, None)))
        holds = (most is None or bad(mean) <= bad(most)) and (most_worst is None or bad(values[worst]) <= most_worst)
        if self.sense == "at most":
            holds = holds and all(one.answers.missing <= MISSING for one in group.values())
        text = ", worst ".join(f"{limit:g}" for limit in (most, most_worst) if limit is not None)
        shown = f"{values[worst]:{'+' if self.sense == 'within' else ''}.3f} ({worst})"
        asked = text if self.sense == "at most" or not text else f"{self.sense} {text}"
        return _finding(self.what, k, estimator, asked, mean, shown, holds if text else None)


MEAN, WITHIN, BIAS = attrgetter("mean_px"), attrgetter("within"), attrgetter("bias_px")
OF_POINTS: Mapping[str, Sequence[Asked]] = {
    "report": (
        Asked("mean error, px", MEAN, {1: (0.4, 0.5), 3: (0.25, 0.35), 10: (0.14, 0.25), 20: (0.10, 0.15)}),
        Asked("within 1 px", WITHIN, {3: (0.97, None)}, "at least"),
    ),
    "dense": (Asked("mean error, px", MEAN, {3: (0.5, None)}),),
    "clear": (
        Asked("mean error, px, all stripes", lambda a: a.over(a.lit).mean_px, {1: (0.8, None)}),
        Asked("mean error, px, all trusted", MEAN, {1: (0.8, None)}),
        Asked("mean error, px, 95 % most confident of all", lambda a: a.over(a.lit).surest(0.95), {1: (0.15, None)}),
        Asked("mean error, px, 95 % most confident of trusted", lambda a: a.surest(0.95), {1: (0.15, None)}),
    ),
    "halo": (
        Asked("mean error, px", MEAN, {5: (1.0, None)}),
        Asked("bias, px", BIAS, {ANY: (None, 0.1)}, "within"),
    ),
}
OVER_NO_HALO = Asked("halo: bias over that without halo, px", BIAS, {ANY: (None, 0.1)}, "within")


def findings(measured: Sequence[Measured]) -> list[Finding]:
    """Everything asked that these answers can tell, estimator after estimator."""
    out: list[Finding] = []
    for estimator in dict.fromkeys(one.estimator for one in measured):
        groups: Groups = {}
        for one in measured:
            if one.estimator == estimator:
                groups.setdefault((one.point, one.exposures), {})[one.scene] = one
        groups = dict(sorted(groups.items()))
        for what in (_of_points, _compared, _extras, _calibration):
            out.extend(what(estimator, groups))
    return out


def _of_points(estimator: str, groups: Groups) -> Iterator[Finding]:
    for point, of_point in OF_POINTS.items():
        for (name, k), group in groups.items():
            for asked in of_point if name == point else ():
                values = {scene: asked.figure(one.answers) for scene, one in group.items()}
                found = asked.finding(k, estimator, group, values)
                yield replace(found, what=f"{point}: {found.what}")


def _compared(estimator: str, groups: Groups) -> Iterator[Finding]:
    """Findings about answers with and without a halo or hot pixels."""
    for (point, k), group in groups.items():
        other = groups.get(({"halo": "halo-less", "hot": "report"}.get(point, ""), k), {})
        shared = [name for name in group if name in other]
        if not shared:
            continue
        if point == "halo":
            added = {name: group[name].answers.bias_px - other[name].answers.bias_px for name in shared}
            yield OVER_NO_HALO.finding(k, estimator, group, added)
            continue
        ratios = {name: group[name].answers.mean_px / other[name].answers.mean_px for name in shared}
        hot, clean = (float(np.mean([each[name].answers.mean_px for name in shared])) for each in (group, other))
        worst = max(ratios, key=ratios.__getitem__)
        yield _finding(
            "hot pixels 1 %: error over that without", k, estimator, f"at most {HOT_TIMES}", hot / clean,
            f"{ratios[worst]:.3f} ({worst})", hot / clean <= HOT_TIMES,
        )  # fmt: skip


def _extras(estimator: str, groups: Groups) -> Iterator[Finding]:
    for (point, k), group in groups.items():
        for one in group.values():
            of = f"{point}, {one.scene}" if one.scene != point else point
            for name, value in one.extras.items():
                asked, holds = "", None
                if "times the bound" in name:
                    asked, holds = f"at most {BOUND_TIMES}", value <= BOUND_TIMES
                elif name.startswith(("pole", "fence")):
                    asked, holds = f"at least {THIN_WITHIN}", value >= THIN_WITHIN
                yield _finding(f"{of}: {name}", k, estimator, asked, value, "", holds)


def _calibration(estimator: str, groups: Groups) -> Iterator[Finding]:
    """Over the scored stripes, and with answers where there is no stripe counted as wrong."""
    of_groups = {key: pooled([one.answers for one in group.values()]) for key, group in groups.items()}
    everything = [(point, str(k), answers) for (point, k), answers in of_groups.items()]
    everything.append(("all points", "", pooled(list(of_groups.values()))))
    for what, exposures, answers in everything:
        for empty, name in ((False, "stripes"), (True, "stripes and rows without")):
            value = calibration_error(*answers.claims(empty=empty))
            told = f"{what}: calibration error, {name}"
            yield _finding(told, exposures, estimator, f"below {CALIBRATION}", value, "", value < CALIBRATION)


def _finding(
    what: str, k: int | str, estimator: str, asked: str, value: float, worst: str, holds: bool | None
) -> Finding:
    verdict = "" if holds is None else "pass" if holds else "short"
    return Finding(what, str(k), estimator, asked, f"{value:.4f}", worst, verdict)
