"""Requests of a user: a frozen dataclass for each command with many options, filled by the options or by a Python call.

Each field has a type and a phrase that describes it, which `rig scan --help` and `help(ScanRequest)` show.
`rig/cli/command.py` makes an option of each field. Each field says what None means; for settings that a config has too,
None means the config's value (`rig/config/models.py`). A value of another type than the field's is a UsageError.
"""

import inspect
import os
from collections.abc import Mapping, Sequence, Set
from dataclasses import Field, dataclass, field, fields
from fractions import Fraction
from numbers import Integral, Real
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from rig.errors import UsageError

Default = TypeVar("Default")
Request = TypeVar("Request")


def option(
    default: Default, about: str, *, unset: str = "", name: str = "", read_as: Any = None, least: int | None = None
) -> Default:
    """Declare a field of a request.

    about: a phrase that describes it. unset: description of the value used if none is given.
    name: of the command line's option, if it differs from the field's. read_as: the type that the command line reads,
    if it differs from the field's. least: the smallest value allowed.
    """
    told = {"about": about, "unset": unset, "name": name, "read_as": read_as, "least": least}
    return field(default=default, metadata=told)


def path_option(about: str, unset: str) -> str | os.PathLike[str] | None:
    """Declare a field that holds a file or folder, None if none is given."""
    return option(None, about, unset=unset, read_as=Path | None)


def options_of(request: type) -> "list[Field[Any]]":
    """The fields of a request in the order of its help: its own fields, then inherited ones."""
    by_name = {each.name: each for each in fields(request)}
    names = (name for part in request.__mro__ for name in inspect.get_annotations(part))
    return [by_name[name] for name in dict.fromkeys(names)]


def described(request: type[Request]) -> type[Request]:
    """Add a line for each field to the docstring of a request."""
    told = [(each, each.metadata["unset"] or each.default) for each in options_of(request)]
    lines = [f"{each.name}: {each.metadata['about']} (default: {default})." for each, default in told]
    request.__doc__ = "\n".join([request.__doc__ or "", "", *lines])
    return request


def request_content(request: object) -> dict[str, Any]:
    """The fields of a request as plain values, for the manifest. Paths become text; config, note and tags have keys of
    their own there, and the folder is the run's own."""
    left_out = ("out", "config", "note", "tags")
    values = {each.name: getattr(request, each.name) for each in options_of(type(request)) if each.name not in left_out}
    return {name: os.fspath(value) if isinstance(value, os.PathLike) else value for name, value in values.items()}


class CheckedRequest:
    """The base of all requests."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Raise UsageError, with a line for each field whose value is of another type."""
        problems = [
            f"`{name}` is {value!r}; it must be {' or '.join(_WORDS[each] for each in types if each in _WORDS)}"
            for name, types in _types_of(type(self)).items()
            if not any(_is_of(value := getattr(self, name), each) for each in types)
        ]
        if problems:
            raise UsageError.of(problems)


_WORDS: Mapping[Any, str] = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "text",
    Fraction: "a fraction",
    os.PathLike[str]: "a path",
    Sequence[str]: "a list of text",
    Sequence[int]: "a list of whole numbers",
}


def _types_of(request: type) -> Mapping[str, tuple[Any, ...]]:
    """The types that each field may have; fields of any type are left out."""
    hints = {name: hint for name, hint in get_type_hints(request).items() if hint is not Any}
    return {name: get_args(hint) if get_origin(hint) is UnionType else (hint,) for name, hint in hints.items()}


def _is_of(value: object, wanted: Any) -> bool:
    if get_origin(wanted) is Sequence:
        of = get_args(wanted)[0]
        if isinstance(value, str) or not isinstance(value, Sequence | Set):
            return False
        return all(_is_of(each, of) for each in value)
    if wanted is bool and type(value).__name__ in ("bool", "bool_"):  # numpy's, which is not imported here
        return True
    if wanted in (int, float):  # numpy's are numbers too; True is one only by an accident of Python
        return isinstance(value, Integral if wanted is int else Real) and not isinstance(value, bool)
    return isinstance(value, get_origin(wanted) or wanted)


# Fields that several requests have.


def _out() -> str | os.PathLike[str] | None:
    return path_option("folder to write, new or empty", "nothing is written")


def _accept_calibration() -> bool:
    return option(False, "use a calibration of another rig, failed or too old, all the same")


def _accuracy() -> str | None:
    about = "depth error (standard deviation) that is good enough: '10 mm'"
    return option(None, about, unset="that of 0.1 pixels")


def _at() -> str:
    return option("5 m", "distance at which it counts")


def _exposures_by_turns() -> Sequence[int]:
    return option((), "frames per column, by turns: 3,10,20", unset="0.3 to 2 x the config's")


def _board_scene() -> str | None:
    return option(None, "of a simulated rig, with a board", unset="its own, else board")


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructRequest(CheckedRequest):
    """Depth maps of existing frames (`rig reconstruct`)."""

    estimator: str | None = option(None, "auto, argmax, edge, likelihood or joint", unset="as configured, else auto")
    filter: str | None = option(
        None, "none or median (5 x 5; for edge and likelihood, not for joint)", unset="as configured, else none"
    )
    min_confidence: float | None = option(None, "least confidence in the depth map", unset="as configured, else 0.5")
    accept_calibration: bool = _accept_calibration()
    out: str | os.PathLike[str] | None = _out()


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class RunRequest(ReconstructRequest):
    """A run with open devices."""

    maps: int | None = option(1, "depth maps to take")
    save: str | None = option(None, "maps to write: all, last or every N", unset="all")
    record: bool = option(False, "write the frames into the folder too")
    on_overload: str = option("abort", "where frames come too fast: abort, drop (and count) or block (wait)")
    arm: bool = option(False, "let a real laser shine: the beam path is clear")
    note: str | None = option(None, "text to keep with the run, for people", unset="none")
    tags: Sequence[str] = option((), "words to find the run by, separated by commas", unset="none", name="tag")


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class ScanRequest(RunRequest):
    """A scan with a rig (`rig scan`)."""

    scene: str | None = option(None, "a bundled scene, a scene file or a folder (simulated rigs)", unset="the config's")
    exposures: int | None = option(None, "frames per column (K)", unset="the config's")
    temporal_prior: bool | None = option(None, "joint: hold each map to the last one a little", unset="the config's")
    learned: str | os.PathLike[str] | None = path_option(
        "file that keeps what the estimator has learned, for the next scan's first map", "the config's, else none"
    )
    seed: int = option(0, "seed of everything simulated")
    record_on_request: bool = option(False, "record parts of the scan, between 'rig record on' and 'rig record off'")
    before: str | None = option(None, "how long before 'rig record on' a part begins: '2 s'", unset="0 s")


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayRequest(RunRequest):
    """A recording that is played as if it were taken now (`rig replay`)."""

    clock: str = option("realtime", "realtime, max, x4 or x0.1, or step (Enter: one sweep more)")
    loop: bool = option(False, "play it again and again, until Ctrl-C or `maps`")
    maps: int | None = option(None, "depth maps to make", unset="all")
    config: Any = option(
        None,
        "a rig whose scanner, laser and sync source take part, like hil",
        unset="recorded ones",
        read_as=str | None,
    )
    threads: int | None = option(None, "threads that count and estimate", unset="as recorded")
    block_frames: int | None = option(None, "most frames of a block", unset="5 ms", least=1)
    save: str | None = option(None, "maps to write: all, last or every N", unset="all, of the command with `loop` last")
    on_overload: str = option("abort", "where frames come too fast: abort and block wait, drop counts them")


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class AlignRequest(CheckedRequest):
    """A look at the laser line at low power, to set a rig up (`rig align`)."""

    power: str | None = option(None, "of the laser, such as '5 mW'", unset="a tenth of its limit")
    seconds: float | None = option(None, "time after which it ends", unset="until Ctrl-C")
    scene: str | None = option(None, "a bundled scene, a scene file or a folder (simulated rigs)", unset="the config's")
    exposures: int | None = option(None, "frames per column (K)", unset="the config's")
    seed: int = option(0, "seed of everything simulated")
    arm: bool = option(False, "let a real laser shine: the beam path is clear")


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class TradeoffRequest(CheckedRequest):
    """Scans of a simulated rig with all combinations of some settings (`rig tradeoff`)."""

    scenes: Sequence[str] = option(
        (), "scenes, by commas", unset="the config's; street,ramp for strategies", name="scene"
    )
    fogs: Sequence[str] = option(
        (),
        "visibilities or clear; for strategies also rain, snow, own",
        unset="the scene's, six for strategies",
        name="fog",
    )
    exposures: Sequence[int] = option((), "frames per column (K)", unset="1,3,10")
    lines: Sequence[int] = option((), "lines at once", unset="the config's")
    estimators: Sequence[str] = option((), "of argmax, edge, likelihood, joint, by commas", unset="all but argmax")
    filters: Sequence[str] = option((), "of none, median (5 x 5), by commas", unset="none,median")
    repeat: int = option(1, "scans of each, for the confidence intervals")
    seed: int = option(0, "seed of the first of them")
    limits: bool = option(True, "compare with the statistical limit of the scene's light")
    time_budget: str | None = option(None, "'5 ms': what has the least error in it")
    error: str | None = option(None, "'0.1 px': what takes the least time for it")
    of: str = option("sensor", "whose time these mean: sensor or compute")
    accept_calibration: bool = _accept_calibration()
    out: str | os.PathLike[str] | None = _out()


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class StrategiesRequest(TradeoffRequest):
    """Other ways to measure depth beside the line scan, in front of simulated scenes (`rig tradeoff --strategies`).

    Of the options of a trade-off, scenes, fogs, repeat, seed and out hold; the others must be left alone.
    """

    strategies: Sequence[str] = option((), "ways to measure depth, or all, by commas", unset="none: settings are tried")
    times: Sequence[str] = option((), "times for strategies, by commas", unset="1ms,10ms,50ms,200ms,1s")
    rules: Sequence[str] = option((), "for strategies: energy, irradiance", unset="both")
    rows: int = option(64, "image rows for strategies, in the middle of the picture", least=1)
    lux: float | None = option(None, "ambient light for strategies", unset="the scene's, else 5")


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class BatchRequest(CheckedRequest):
    """All cases of a study, on this computer or on many (`rig batch`)."""

    out: str | os.PathLike[str] | None = path_option("folder of the study: new, or to go on with", "none")
    cluster: str | os.PathLike[str] | None = option(
        None, "local (processes of this computer), tcp://HOST:PORT of a dask scheduler, or a YAML file", unset="local",
        read_as=str | None,
    )  # fmt: skip
    workers: int | None = option(None, "cases at once on this computer", unset="as cores and memory allow")
    shard: str | None = option(None, "only a share of the cases: 3/10 is the third of ten", unset="all")


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class SoakRequest(CheckedRequest):
    """A long stream at the sensor's rate, played in real time (`rig bench --soak`)."""

    threads: int | None = option(None, "most threads to count and estimate with", unset="one a core", least=1)
    seconds: float | None = option(
        None, "also play so many seconds of stream in real time", unset="no stream; 60 in Python", name="soak"
    )
    window: bool = option(False, "stream of moving windows instead of whole frames")
    slow_consumer_ms: float = option(0.0, "milliseconds added to every map of the stream", name="slow_consumer")
    on_overload: str = option("abort", "where frames of the stream come too fast: abort, drop or block")
    estimator: str = option("likelihood", "of the stream: argmax, edge, likelihood or joint")
    exposures: int | None = option(None, "frames per column of the stream", unset="10", least=1)


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class RunsRequest(CheckedRequest):
    """A list of the runs in a folder (`rig runs`). A run is listed if it passes every filter that is given."""

    tags: Sequence[str] = option((), "with all of these tags, separated by commas", unset="any", name="tag")
    note: str | None = option(None, "with this text in the note, in capital or small letters", unset="any")
    verdict: str | None = option(None, "of this verdict, such as complete, gaps or damaged", unset="any")
    since: str | None = option(
        None, "taken since a date '2025-11-29', a time '2025-11-29 14:00' or '7 d' ago", unset="any"
    )
    config: str | None = option(None, "of the rig with this name in its config", unset="any")
    scene: str | None = option(None, "of this scene (simulated rigs)", unset="any")
    estimator: str | None = option(None, "estimated with this one", unset="any")


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class ViewRequest(CheckedRequest):
    """A page in the browser that shows a run (`rig view`)."""

    host: str = option("127.0.0.1", "address to listen on; 0.0.0.0 is the whole network, with a token")
    port: int = option(8765, "to listen on; 0 takes any free one")
    token: str | None = option(None, "that opens the page", unset="none on 127.0.0.1, else made anew")
    open_browser: bool = option(False, "open the page in this computer's browser", name="open")
    view_points: int = option(250_000, "most points of an update, at most 250000")
    view_rate: float = option(10.0, "most updates a second, at most 10")
    until_closed: bool = option(False, "end with the scan, once no page is open")
    process: int | None = option(None, "number of the process whose scans alone are shown live", unset="any")


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class StreamRequest(CheckedRequest):
    """A stream of depth maps for other programs (`rig stream`)."""

    host: str = option("127.0.0.1", "address to listen on; 0.0.0.0 is the whole network, with a token")
    port: int = option(8766, "to listen on; 0 takes any free one")
    token: str | None = option(None, "that clients must send", unset="none on 127.0.0.1, else made anew")


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class CutRequest(CheckedRequest):
    """A part of a recording (`rig cut`). Give exactly one of `maps`, `frames` and `time`."""

    maps: str | None = option(None, "A:B, maps A to before B, from 0")
    frames: str | None = option(None, "A:B, frames A to before B")
    time: str | None = option(None, "A:B, seconds A to B from the first frame")
    start: int = option(0, "of `frames` and `time`: which start of the SPAD, from 0")


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class ImportRequest(CheckedRequest):
    """Import of frames from another program's files (`rig import`)."""

    form: str | None = option(
        None, "pi-imaging: packed or sparse; swissspad2: half or full; photoncube: packed", unset="as it looks; half"
    )
    frame_rate: str | Fraction | None = option(
        None, 'such as "97.7 kHz"; hertz as a fraction', unset="not known", read_as=str | None
    )
    turn_deg: int | None = option(
        None, "turn frames counter-clockwise: 0, 90, 180 or 270", unset="90 for pi-imaging, else 0", name="rotate"
    )
    rows: int | None = option(None, "pi-imaging: 512, or 1024 of the 1M sensor", unset="512")


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class ExportRequest(CheckedRequest):
    """Pictures and films of a run (`rig export`)."""

    view: str | None = option(
        None, "png, mp4: depth, intensity or frames (sums of recorded frames)", unset="the first that there is"
    )
    frames_per_picture: int | None = option(None, "frames summed for a picture", unset="100", name="frames")
    pictures_per_s: float | None = option(None, "pictures of a film a second", unset="25", name="fps")


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationRequest(CheckedRequest):
    """A calibration with a rig, or with frames taken with one."""

    seed: int = option(0, "seed of everything simulated")
    arm: bool = option(False, "let a real laser shine: the beam path is clear")
    out: str | os.PathLike[str] | None = _out()


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class PixelsRequest(CalibrationRequest):
    """A map of hot, dead and noisy pixels (`rig calibrate pixels`)."""

    frames: int | None = option(None, "dark ones", unset="as many as the limit of hot pixels needs")
    lit: str | os.PathLike[str] | None = path_option("a recorded run whose lit frames tell dead pixels", "none")
    light: bool = option(False, "take lit frames now")
    against: str | os.PathLike[str] | None = path_option("an older map, for the drift", "that of the calibration")


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class BoardRequest(CalibrationRequest):
    """A calibration with views of a board."""

    board: str | os.PathLike[str] | None = path_option("what is printed on the board: its YAML file", "the bundled")
    poses: int = option(12, "of the board, shown to a live rig")
    scene: str | None = _board_scene()


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRequest(BoardRequest):
    """A calibration of the camera alone (`rig calibrate camera`)."""

    terms: int = option(5, "of the lens model, as OpenCV counts them: 0, 4, 5, 8, 12 or 14")


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class PlanesRequest(BoardRequest):
    """A calibration of camera, light planes and lag together (`rig calibrate planes`)."""

    guided: bool = option(False, "ask for the poses that help most, until it is enough or all poses were shown")
    calibration: str | os.PathLike[str] | None = path_option("one to start from; its defects are kept", "none")
    camera: str | os.PathLike[str] | None = path_option("camera.yaml of calibrate camera, of other views", "none")
    stated_baseline: str | None = option(None, "camera to mirror as measured: '300 mm'", unset="not known")
    accuracy: str | None = _accuracy()
    at: str = _at()
    exposures: Sequence[int] = _exposures_by_turns()
    accept_calibration: bool = option(False, "use a `camera` whose verdict failed all the same")


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class SyncRequest(CalibrationRequest):
    """A measurement of the mirror's lag and the rows' delay (`rig calibrate sync`)."""

    calibration: str | os.PathLike[str] | None = path_option("the lags go into a copy of it", "the rig's own")
    accuracy: str | None = _accuracy()
    at: str = _at()
    exposures: Sequence[int] = _exposures_by_turns()
    scene: str | None = _board_scene()


@described
@dataclass(frozen=True, slots=True, kw_only=True)
class CheckRequest(BoardRequest):
    """A check of a calibration by a board that was not used for it (`rig calibrate check`)."""

    poses: int = option(1, "of the board, shown to a live rig; at least 2 with `angle`")
    calibration: str | os.PathLike[str] | None = path_option("what to check", "the rig's own")
    angle: str | None = option(
        None, "between the boards of the first two views, as stated: '30 deg'", unset="not known"
    )
    accuracy: str | None = _accuracy()
    at: str = _at()
