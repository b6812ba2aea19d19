"""What a calibration file may say, section by section."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from calibration.verdict import VerdictWord

FORMAT = "spadrig-calibration"
VERSION = 1

Number = Annotated[float, Field(allow_inf_nan=False)]
Triple = Annotated[list[Number], Field(min_length=3, max_length=3)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]
Row = Annotated[list[Number], Field(min_length=4, max_length=4)]
PlaneRows = str | list[Row]


class Section(BaseModel):
    """A part of a file: what it does not know is refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class CameraSection(Section):
    """The camera, in pixels."""

    width: int
    height: int
    matrix: list[Triple]
    distortion: list[Number] = []


class TableSection(Section):
    """Planes at commands."""

    command: list[Number]
    planes: PlaneRows


class PivotSection(Section):
    """A mirror that turns about an axis, as `PivotScanner` has it."""

    axis_point_m: Triple
    axis_direction: Triple
    zero_normal: Triple
    angle_rad: list[Number]
    command_range: Pair = [-1.0, 1.0]
    offset_m: list[Number] = []
    cone_rad: Number = 0.0
    bow_per_rad: Number = 0.0


class ScannerSection(Section):
    """One of the two forms."""

    table: TableSection | None = None
    pivot: PivotSection | None = None

    @model_validator(mode="after")
    def _one(self) -> "ScannerSection":
        if (self.table is None) == (self.pivot is None):
            raise ValueError("give exactly one of 'table' and 'pivot'")
        return self


class LagSection(Section):
    """By how much the mirror follows a rising and a falling command."""

    forward: Number = 0.0
    backward: Number = 0.0


class CovarianceSection(Section):
    """Names of the parameters, and the file of their matrix."""

    names: list[str]
    file: str


class IdentitySection(Section):
    """Of which rig, as `Identity` has it."""

    rig: str
    created: str
    name: str = ""
    kinds: dict[str, str] = {}
    serials: dict[str, str] = {}
    verdict: VerdictWord | None = None
    reasons: list[str] = []


class ProvenanceSection(BaseModel):
    """Where it is from: what anybody likes to note, and the two notes that programs go by."""

    model_config = ConfigDict(extra="allow", frozen=True)

    velocities_per_s: list[Number] | None = None
    corners: list[str] | None = None


class CalibrationFile(Section):
    """The whole file."""

    format: Literal["spadrig-calibration"]
    version: Literal[1]
    camera: CameraSection
    planes: PlaneRows | None = None
    scanner: ScannerSection | None = None
    source_m: Triple | None = None
    lag_s: LagSection = LagSection()
    speed_range_per_s: Pair | None = None
    row_delay_s: Number = 0.0
    gate_delay_s: Number = 0.0
    colour_skew_s: Number = 0.0
    marker_rising: bool = True
    defects: str | None = None
    dark_rate: str | None = None
    covariance: CovarianceSection | None = None
    identity: IdentitySection | None = None
    provenance: ProvenanceSection = ProvenanceSection()

    @model_validator(mode="after")
    def _one_scanner(self) -> "CalibrationFile":
        if (self.planes is None) == (self.scanner is None):
            raise ValueError("give exactly one of 'planes' and 'scanner'")
        return self
