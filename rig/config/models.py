"""The config of a rig: which devices, which calibration, what scan and which estimate; validated with units and limits.

Times, rates and lengths are text with a unit in YAML ("10 us", "100 kHz", "8 m"). The sections of devices (slots:
`spad`, `scanner`, ...) hold the config model of their kind, which is defined with its driver. `rig.config.files` reads
files.

A rig may project several lines at once. With L lines the mirror sweeps one L-th of the field, so a map takes one L-th
of the frames. `scan.command_range` is the range of the mirror, and the columns of line l lie at the mirror's commands
plus `line_offsets[l]`.
"""

import os
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializeAsAny,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from drivers.errors import UnknownKind
from drivers.registry import KindConfig, kinds, lookup
from drivers.units import Age, ExactHertz, Metres, Seconds, Watts
from rig.config.estimators import AUTO as AUTO
from rig.config.estimators import estimator_names, is_estimator

MOST_LINES = 16
MOST_THREADS = 256
LEAST_FRESH = 0.5
"""Least distance of neighbouring lines, as a share of the mirror's sweep: closer lines light most places twice."""

LinePower = Literal["shared", "each"]


def _in_order(value: tuple[float, ...]) -> tuple[float, ...]:
    if not 1 <= len(value) <= MOST_LINES:
        raise ValueError(f"names {len(value)} lines; a rig has 1 to {MOST_LINES}")
    if len(value) == 1 and value[0] != 0:
        raise ValueError(f"has the one offset {value[0]:g}; a single line stands at 0, add others or leave it out")
    for first, second in pairwise(value):
        if not first < second:
            raise ValueError(f"has {second:g} behind {first:g}; it must ascend")
    return value


LineOffsets = Annotated[
    tuple[Annotated[float, Field(ge=-2, le=2, allow_inf_nan=False)], ...],
    AfterValidator(_in_order),
    Field(
        description="places of 1 to 16 lines that leave the mirror together, in units of its command, ascending",
        examples=["[-0.22, 0.22]"],
    ),
]


MIN_DARK_FRACTION = 0.05
"""Smallest share of a sweep's frames that must be dark: the dark rate is learned from them. A `CubePlan` has none."""


def _installed_estimator(name: str) -> str:
    if not is_estimator(name):
        *others, last = (repr(each) for each in (AUTO, *estimator_names()))
        expected = f"{', '.join(others)} or {last}"
        # The type of error of a field with fixed choices, so that the message is the same.
        raise PydanticCustomError("literal_error", "Input should be {expected}", {"expected": expected})
    return name


def _list_estimators(schema: dict[str, Any]) -> None:
    schema["enum"] = [AUTO, *estimator_names()]


Estimator = Annotated[str, AfterValidator(_installed_estimator)]
"""Name of an estimator, of this program or another installed package, or `auto`."""
Filter = Literal["none", "median"]


class ConfigSection(BaseModel):
    """Base of the config's sections. Unknown keys are refused and values cannot change."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def _near_below_far(value: tuple[float, float]) -> tuple[float, float]:
    near, far = value
    if not 0 < near < far:
        raise ValueError(f"runs from {near:g} m to {far:g} m; it must be [near, far] with 0 m < near < far")
    return value


def _two_ends(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] == value[1]:
        raise ValueError(f"begins and ends at {value[0]:g}; the sweep needs two different ends")
    return value


DepthRange = Annotated[
    tuple[Metres, Metres],
    AfterValidator(_near_below_far),
    Field(
        description="nearest and farthest depth to look for; a narrower range is faster and gives fewer wrong answers",
        examples=["[1 m, 8 m]"],
    ),
]
Columns = Annotated[int, Field(ge=1, le=65535, description="laser line positions of a sweep", examples=[500])]
Exposures = Annotated[int, Field(ge=1, le=65535, description="frames nominally taken per column (K)", examples=[10])]
FrameRate = Annotated[ExactHertz, Field(gt=0, description="SPAD frames per second", examples=["100 kHz"])]
Command = Annotated[float, Field(ge=-1, le=1, allow_inf_nan=False)]


class ScanConfig(ConfigSection):
    """Settings of one sweep."""

    columns: Columns = 500
    exposures: Exposures = 10
    frame_rate: FrameRate
    depth_range: DepthRange
    command_range: Annotated[
        tuple[Command, Command],
        AfterValidator(_two_ends),
        Field(
            description="mirror drive at the outer edges of the first and the last column; may run downward. Run-in "
            "and run-out need room beyond it",
            examples=["[-0.9, 0.9]"],
        ),
    ] = (-0.9, 0.9)
    bidirectional: bool = Field(
        default=False, description="use the mirror's way back as a sweep of its own", examples=["false"]
    )
    dark_fraction: float = Field(
        default=MIN_DARK_FRACTION,
        ge=MIN_DARK_FRACTION,
        lt=1,
        description="least share of a sweep's frames taken with the gate low, from which dark counts are learned",
        examples=[0.05],
    )
    exposure: Annotated[Seconds, Field(gt=0)] | None = Field(
        default=None,
        description="exposure of a frame, at most the frame period; the whole period where not given",
        examples=["10 us"],
    )
    power: Annotated[Watts, Field(gt=0)] | None = Field(
        default=None, description="laser power of the scan; the laser's limit where not given", examples=["20 mW"]
    )

    @property
    def exposure_s(self) -> float:
        """Exposure of a frame; if it is not set, the whole frame period."""
        return float(1 / self.frame_rate) if self.exposure is None else self.exposure

    @model_validator(mode="before")
    @classmethod
    def _has_no_passes(cls, content: Any) -> Any:
        if not isinstance(content, dict) or "adaptive" not in content:
            return content
        if content["adaptive"] is not None:
            raise ValueError("adaptive scans in passes are no longer made; leave the key 'adaptive' out")
        return {key: value for key, value in content.items() if key != "adaptive"}

    @model_validator(mode="after")
    def _exposure_fits(self) -> Self:
        if self.exposure is not None and self.exposure > float(1 / self.frame_rate) * (1 + 1e-9):
            raise ValueError(
                f"exposure is {self.exposure * 1e6:g} us, longer than the {float(1e6 / self.frame_rate):g} us of a "
                f"frame at {float(self.frame_rate):g} Hz; shorten exposure or lower frame_rate"
            )
        return self


def _beside_config(value: Path | None, info: ValidationInfo) -> Path | None:
    folder = (info.context or {}).get("folder") or ""
    return None if value is None else Path(folder) / os.path.expanduser(value)


class EstimateConfig(ConfigSection):
    """Settings of the estimate, which turns counts into depth."""

    estimator: Estimator = Field(
        default=AUTO,
        description="how the stripe is found on each row; auto is joint where that is fast enough, else likelihood",
        examples=["joint"],
        json_schema_extra=_list_estimators,
    )
    filter: Filter = Field(
        default="none",
        description="what is done to the stripe positions afterwards: median is one of 5 x 5 rows and columns, for "
        "edge and likelihood",
        examples=["median"],
    )
    min_confidence: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="answers below it do not enter the depth map; the stripe table keeps them",
        examples=[0.5],
    )
    keep_floating: bool = Field(
        default=False,
        description="keep points of the depth map that float between two surfaces; else they are left out and counted",
        examples=["true"],
    )
    temporal_prior: bool = Field(
        default=False,
        description="hold each map to the last one a little, for scenes that mostly stand still; joint only",
        examples=["true"],
    )
    learned: Annotated[Path | None, AfterValidator(_beside_config)] = Field(
        default=None,
        description="file in which scans keep what the estimator has learned, for the next one's first map; relative "
        "to this file",
        examples=["learned.npz"],
    )
    threads: int | None = Field(
        default=None,
        ge=1,
        le=MOST_THREADS,
        description="threads that count and estimate, null for one a core; results do not depend on it",
        examples=[2],
    )

    @field_validator("temporal_prior")
    @classmethod
    def _prior_is_of_joint(cls, value: bool, info: ValidationInfo) -> bool:
        estimator = info.data.get("estimator", "joint")  # missing if the estimator itself is not valid
        if value and estimator not in (AUTO, "joint"):
            raise ValueError(
                f"is for the estimator joint, this is {estimator}; choose estimator joint or leave the prior off"
            )
        return value


def _of_slot(slot: str) -> BeforeValidator:
    """A validator for the section of a device or world: makes it the config model of the kind that it names."""

    def validate(value: object, info: ValidationInfo) -> object:
        if isinstance(value, KindConfig):
            value = value.model_dump(mode="json")
        if not isinstance(value, dict):
            raise ValueError(f"is {value!r}; it must be a mapping that names a kind of: {', '.join(kinds(slot))}")
        if "kind" not in value:
            raise ValueError(f"has no 'kind'; add one of: {', '.join(kinds(slot))}")
        try:
            kind = lookup(slot, str(value["kind"]))
        except UnknownKind as error:
            raise ValueError(str(error).removeprefix(f"{slot}: ")) from error
        return kind.config.model_validate(value, context=info.context)

    return BeforeValidator(validate)


class RigConfig(ConfigSection):
    """A whole rig and the scan that it makes."""

    name: str = Field(min_length=1, description="name of the rig, for people", examples=["lab"])
    calibration: Annotated[Path | None, AfterValidator(_beside_config)] = Field(
        default=None,
        description="calibration file, relative to this file; without one there are stripes but no depth",
    )
    calibration_max_age: Annotated[Age, Field(gt=0)] | None = Field(
        default=None,
        description="age from which on a calibration that says when it was made is refused; null for any age",
        examples=["90 d"],
    )
    world: Annotated[SerializeAsAny[KindConfig], _of_slot("world")] | None = Field(
        default=None, description="what simulated devices look at; real rigs have none"
    )
    spad: Annotated[SerializeAsAny[KindConfig], _of_slot("spad")]
    scanner: Annotated[SerializeAsAny[KindConfig], _of_slot("scanner")]
    laser: Annotated[SerializeAsAny[KindConfig], _of_slot("laser")]
    sync: Annotated[SerializeAsAny[KindConfig], _of_slot("sync")]
    line_offsets: LineOffsets = (0.0,)
    line_power: LinePower = Field(
        default="shared",
        description="whether lines share the laser's power (a diffractive element) or each has it (more lasers)",
        examples=["shared"],
    )
    scan: ScanConfig
    estimate: EstimateConfig = EstimateConfig()

    @model_validator(mode="after")
    def _lines_fit(self) -> Self:
        problems = line_problems(self.line_offsets, self.scan.columns, self.scan.command_range)
        if problems:
            raise ValueError("; ".join(problems))
        return self


class CubePlan(ConfigSection):
    """`plan.yaml` of `rig reconstruct`: how a bare cube of frames, without markers, was taken."""

    columns: Columns
    exposures: Exposures
    frame_rate: FrameRate
    depth_range: DepthRange


def line_problems(offsets: Sequence[float], columns: int, command_range: tuple[float, float]) -> list[str]:
    """Problems with scanning `columns` columns with lines at `offsets` while the mirror sweeps `command_range`."""
    lines = len(offsets)
    problems = []
    if columns % lines:
        below, above = columns // lines * lines, -(-columns // lines) * lines
        fits = f"{above}" if below == 0 else f"{below} or {above}"
        problems.append(f"scan.columns is {columns}, no multiple of the {lines} lines of line_offsets; make it {fits}")
    span = abs(command_range[1] - command_range[0])
    spare = span * lines / columns  # one place of the mirror; lines farther apart than span + spare leave a gap
    for first, second in pairwise(offsets):
        apart = second - first
        told = f"line_offsets {first:g} and {second:g} are {apart:g} apart, scan.command_range spans {span:g}"
        if apart > span + spare:
            problems.append(
                f"{told}: what lies between them is never lit; widen it to {apart:g} or bring the lines closer"
            )
        elif apart < LEAST_FRESH * span:
            problems.append(f"{told}: most of it would be lit twice; narrow it to {apart:g}")
    return problems
