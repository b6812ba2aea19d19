"""The sections of a calibration file, and the only reader of YAML files.

The reader limits size, depth and repetition. A key may occur only once. Errors are one line.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, model_validator

from calibration.errors import FileError, plain_text
from calibration.files.problems import MAX_PROBLEMS, Key
from calibration.verdict import VerdictWord

FORMAT = "spadrig-calibration"

Number = Annotated[float, Field(allow_inf_nan=False)]
Triple = Annotated[list[Number], Field(min_length=3, max_length=3)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]
Row = Annotated[list[Number], Field(min_length=4, max_length=4)]
PlaneRows = str | list[Row]


class FileSection(BaseModel):
    """A part of a file. Unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class CameraSection(FileSection):
    """The camera: size and matrix in pixels, and OpenCV's distortion terms."""

    width: int
    height: int
    matrix: list[Triple]
    distortion: list[Number] = []


class TableSection(FileSection):
    """A table of light planes at mirror commands."""

    command: list[Number]
    planes: PlaneRows


class PivotSection(FileSection):
    """A mirror that turns about an axis, with the fields of `PivotScanner`."""

    axis_point_m: Triple
    axis_direction: Triple
    zero_normal: Triple
    angle_rad: list[Number]
    command_range: Pair = [-1.0, 1.0]
    offset_m: list[Number] = []
    cone_rad: Number = 0.0
    bow_per_rad: Number = 0.0


class ScannerSection(FileSection):
    """The scanner, in one of its two forms."""

    table: TableSection | None = None
    pivot: PivotSection | None = None

    @model_validator(mode="after")
    def _one(self) -> "ScannerSection":
        if (self.table is None) == (self.pivot is None):
            raise ValueError("give exactly one of 'table' and 'pivot'")
        return self


class LagSection(FileSection):
    """The lags, in seconds, of the mirror behind a rising and a falling command."""

    forward: Number = 0.0
    backward: Number = 0.0


class CovarianceSection(FileSection):
    """Names of the parameters, and the file of their matrix."""

    names: list[str]
    file: str


class IdentitySection(FileSection):
    """The identity of the rig, with the fields of `Identity`."""

    rig: str
    created: str
    name: str = ""
    kinds: dict[str, str] = {}
    serials: dict[str, str] = {}
    verdict: VerdictWord | None = None
    reasons: list[str] = []


class ProvenanceSection(BaseModel):
    """The origin of a calibration: free notes, and the two entries that programs use."""

    model_config = ConfigDict(extra="allow", frozen=True)

    velocities_per_s: list[Number] | None = None
    corners: list[str] | None = None


class CalibrationFile(FileSection):
    """The whole calibration file."""

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


MAX_BYTES: Final = 64 << 20
"""Largest file: the plan of a long scan takes a hundredth of that."""
MAX_DEPTH: Final = 64
"""Most levels of nested lists and mappings."""
MAX_NODES: Final = 4_000_000
"""Most values in a file, without those that aliases repeat."""
MAX_REPEATED: Final = 100_000
"""Most values that aliases may repeat: with nested aliases, nine lines can stand for a billion values."""
MAX_WHOLE: Final = 1 << 64
"""Whole numbers must be smaller in size: counts, identifiers and seeds have at most 64 bits."""
_MOST_KEY: Final = 200
"""Most characters of a key."""
_MOST_DIGITS: Final = 400
"""Most characters of a number in base 60."""
_NUMBERS: Final = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
_MOST_SHOWN: Final = 40


@dataclass(frozen=True, slots=True)
class YamlFile:
    """A file's keys and values, with the text and the YAML nodes that they were read from."""

    content: dict[str, Any]
    text: str
    node: yaml.MappingNode

    def lines(self) -> dict[Key, int]:
        """The line of each key and of each item of a list, by its path."""
        return dict(_places(self.node, ()))


def load_yaml(file: Path, what: str, example: str, name: str | None = None) -> YamlFile:
    """Read the keys and values of a YAML file. what: its kind for messages, such as 'a calibration'. example: an entry
    to show in messages. name: the file's name in messages, by default its path. Raises FileError if the file cannot be
    read, exceeds a limit of this module, is no YAML in UTF-8, holds no keys and values, or gives a key twice."""
    name = str(file) if name is None else name
    if "\0" in str(file):
        raise FileError(f"cannot read {what.split()[-1]} {plain_text(name)}: it is no path; correct it")
    try:
        size = file.stat().st_size
        if size > MAX_BYTES:
            raise FileError(
                f"{name} has {size / 1e6:.0f} MB, {what} has at most {MAX_BYTES / 1e6:.0f} MB; name another file"
            )
        text = file.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise FileError(f"cannot read {what.split()[-1]} {name}: {error.strerror or error}; check the path") from error
    except UnicodeDecodeError as error:
        raise FileError(f"{name} is not text in UTF-8; {what} is a YAML file") from error
    return parse_yaml(text, what, example, name)


def parse_yaml(text: str, what: str, example: str, name: str) -> YamlFile:
    """The keys and values of a file's text. Arguments and errors as in `load_yaml`."""
    try:
        _require_bounded(text)
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
            twice = [] if node is None else _twice(node, name)  # before merge keys are resolved, which may repeat keys
            content = None if node is None else loader.construct_document(node)
        finally:
            loader.dispose()
    except _Refused as error:
        raise FileError(f"{name}:{error}") from error.__cause__
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f":{mark.line + 1}" if mark is not None else ""
        why = getattr(error, "problem", None) or getattr(error, "reason", None) or "unreadable"
        raise FileError(f"{name}{where}: not YAML: {why}; check indentation, quotes and brackets there") from error
    if not isinstance(content, dict):
        holds = "a list" if isinstance(content, list) else "a single value"
        kind = "is empty" if content is None else f"holds {holds}"
        raise FileError(f"{name} {kind}; {what} must hold keys and values, e.g. '{example}'")
    if twice:
        told = [f"{name}:{line}: '{'.'.join(key)}' is given twice; keep one" for key, line in twice[:MAX_PROBLEMS]]
        raise FileError(*told, *([f"{name}: {len(twice)} keys are given twice"] if len(twice) > MAX_PROBLEMS else []))
    return YamlFile(content, text, node)


class _Refused(yaml.YAMLError):
    """Raised for YAML that this program does not take. The text begins with the line's number."""

    def __init__(self, mark: Any, why: str) -> None:
        super().__init__(f"{mark.line + 1}: {why}")


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Reads YAML, and reports the line of a value that does not fit its tag or form, such as the date 2024-13-45."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """The value of a node. Raises _Refused for a value that does not fit and for a whole number too large."""
        try:
            if node.tag in _NUMBERS and ":" in node.value and len(node.value) > _MOST_DIGITS:
                raise ValueError("too long")  # in base 60 ('1:30') it would take a time with the square of its length
            value = super().construct_object(node, deep=deep)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            kind = node.tag.rpartition(":")[-1]
            raise _Refused(node.start_mark, f"{_cut(node)} is no {kind}; mend it, or put text in quotes") from error
        if isinstance(value, int) and abs(value) >= MAX_WHOLE:
            raise _Refused(node.start_mark, f"{_cut(node)} is too large, a whole number is below 2^64; lower it")
        return value


def _cut(node: yaml.Node) -> str:
    form = "a list" if isinstance(node, yaml.SequenceNode) else "a mapping"
    text = node.value if isinstance(node.value, str) else form
    return plain_text(text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}...")


def _require_bounded(text: str) -> None:
    """Raise a YAMLError if the text holds, nests or repeats too much, before values are made of it."""
    known: dict[str | None, tuple[int, int]] = {}  # by anchor: the number of values, and how deep they nest
    written = repeated = 0
    events = yaml.parse(text, Loader=_Loader)

    def measured(event: Any, opened: tuple[str | None, ...]) -> tuple[int, int]:
        """The number of values in a node, and how deep they nest; opened: anchors of the nodes around it."""
        nonlocal written, repeated
        size, height = 1, int(isinstance(event, yaml.CollectionStartEvent))
        if isinstance(event, yaml.AliasEvent):
            if event.anchor in opened:
                raise _Refused(
                    event.start_mark, f"'*{event.anchor}' stands within what it repeats; write out what is meant"
                )
            size, height = known.get(event.anchor, (1, 0))
            repeated += size
        else:
            written += 1
        if len(opened) + height > MAX_DEPTH:
            raise _Refused(event.start_mark, f"nested more than {MAX_DEPTH} deep; write it flatter")
        if written > MAX_NODES:
            raise _Refused(event.start_mark, f"more than {MAX_NODES} values; put arrays into .npy files")
        if repeated > MAX_REPEATED:
            raise _Refused(event.start_mark, f"aliases repeat more than {MAX_REPEATED} values; write out what is meant")
        if isinstance(event, yaml.CollectionStartEvent):
            while not isinstance(inner := next(events), yaml.CollectionEndEvent):
                below = measured(inner, (*opened, event.anchor))
                size, height = size + below[0], max(height, below[1] + 1)
        if event.anchor is not None and not isinstance(event, yaml.AliasEvent):
            known[event.anchor] = size, height
        return size, height

    for event in events:
        if isinstance(event, yaml.NodeEvent):
            measured(event, ())


def _places(node: yaml.Node, path: Key) -> Iterator[tuple[Key, int]]:
    """Every key and item below `node` with its line, repeated keys too."""
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            here = (*path, key.value if isinstance(key.value, str) else "?")
            yield here, key.start_mark.line + 1
            yield from _places(value, here)
    elif isinstance(node, yaml.SequenceNode):
        for i, value in enumerate(node.value):
            yield (*path, str(i)), value.start_mark.line + 1
            yield from _places(value, (*path, str(i)))


def _twice(node: yaml.Node, name: str) -> list[tuple[Key, int]]:
    """The keys that are given again, with the lines of their repetitions. Keys below a repeated key are left out.

    Raises FileError for a key that a line on a terminal cannot show, since keys stand in messages. name: of the file.
    """
    seen: set[Key] = set()
    found: dict[Key, int] = {}
    for key, line in _places(node, ()):
        if len(key[-1]) > _MOST_KEY or not key[-1].isprintable():
            what = "characters that cannot be shown" if len(key[-1]) <= _MOST_KEY else f"over {_MOST_KEY} characters"
            raise FileError(f"{name}:{line}: the key '{plain_text(key[-1][:_MOST_SHOWN])}' has {what}; correct it")
        if key in seen and not any(key[:n] in found for n in range(1, len(key) + 1)):
            found[key] = line
        seen.add(key)
    return list(found.items())
