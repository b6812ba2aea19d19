"""Reads what is known of a run for its report. Whatever is missing or damaged is named, and the rest is read."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Final, TypeVar

from calibration.errors import CalibrationError
from calibration.files.rig_file import CALIBRATION_FILE, load_rig_model
from calibration.model.rig_model import RigModel
from drivers.errors import DeviceError
from drivers.recorded.contents import INDEX_FILE
from rig.errors import RigError, UsageError
from rig.recording.map_rows import MapRows, RowCounts
from rig.run_folder.manifest import MANIFEST, read_manifest
from rig.run_folder.map_files import map_numbers, read_arrays, read_depth, read_stripe
from rig.run_folder.pictures import Picture, intensity_picture, read_grey
from rig.run_folder.runs import SUMMARY, read_summary
from rig.simd import Float32

ROWS: Final = 5
"""Number of image rows whose profiles a report shows."""
Read = TypeVar("Read")


@dataclass(frozen=True, slots=True, eq=False)
class RunFacts:
    """A run as far as it can be read. Arrays of pixels are (rows, width), those of stripes (rows, columns).

    manifest, summary: contents of these files, empty if they are missing. recorded: whether the run's folder has
    frames. numbers: numbers of the maps that have files or whole frames. number: number of the map that is shown, None
    without one. depth_m, confidence, depth_sd_m: as in `rig.depth.depth.DepthMap`. stripe: arrays of the stripe table.
    truth: arrays `x_px`, `depth_m`. counts: the picture of the summed counts. rows: the image rows whose profiles are
    shown. counted: the recorded counts of each of these rows. near_is_left: whether near points lie at smaller x.
    model: the calibration. missing: a sentence for each thing that a report shows and this run lacks.
    """

    folder: Path
    manifest: Mapping[str, Any]
    summary: Mapping[str, Any]
    recorded: bool
    numbers: tuple[int, ...] = ()
    number: int | None = None
    depth_m: Float32 | None = None
    confidence: Float32 | None = None
    depth_sd_m: Float32 | None = None
    stripe: Mapping[str, Float32] = field(default_factory=dict)
    truth: Mapping[str, Float32] = field(default_factory=dict)
    counts: Picture | None = None
    rows: tuple[int, ...] = ()
    counted: Mapping[int, RowCounts] = field(default_factory=dict)
    near_is_left: bool = True
    model: RigModel | None = None
    missing: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.absolute().name

    @property
    def verdict(self) -> str:
        """Verdict of the run; 'unknown' if it does not say."""
        return str(self.summary.get("verdict") or self.manifest.get("verdict") or "unknown")

    @property
    def taken(self) -> datetime | None:
        """Date and time of the run; None if it does not say, or does not say the time zone."""
        return _moment((self.manifest.get("rig") or {}).get("taken"))

    @property
    def calibration_age(self) -> timedelta | None:
        """Time from the calibration to the run; None if one of the two is not dated."""
        made = None if self.model is None or self.model.identity is None else _moment(self.model.identity.created)
        return None if made is None or self.taken is None else self.taken - made

    @property
    def ambient(self) -> float:
        """Ambient light of the last map, in photons per pixel and exposure; 0 if none was measured."""
        fog = self.summary.get("fog")
        value = fog.get("ambient_per_exposure") if isinstance(fog, Mapping) else None
        return float(value) if isinstance(value, int | float) else 0.0


def read_run(folder: Path, number: int | None = None) -> RunFacts:
    """Read a run and one of its maps. number: number of the map; None: the last one that was made, else the last
    recorded one.

    Raises UsageError if the run has no map of this number.
    """
    reader = _Reader(folder)
    manifest = reader.file(MANIFEST, _manifest, "the manifest") or {}
    summary = reader.file(SUMMARY, _summary, "the summary") or {}
    recorded = (folder / INDEX_FILE).exists()
    numbers = tuple(map_numbers(folder))
    counted = _counted_maps(folder, reader) if recorded else None
    there = sorted({*numbers, *(counted.maps if counted is not None else ())})
    if number is not None and number not in there:
        has = f"it has maps {there[0]} to {there[-1]}, so name one of these" if there else "it has no map"
        if len(there) == 1:
            has = f"its only map is {there[0]}"
        raise UsageError(f"map {number} is not in {folder}; {has}")
    shown = number if number is not None else (numbers or there or (None,))[-1]
    facts: dict[str, Any] = {"numbers": tuple(there), "number": shown}
    if not numbers:
        reader.missing.append("No map was made" + (": rig reconstruct makes maps of the frames." if recorded else "."))
    if shown in numbers:
        facts |= _map_files(reader, f"{shown:06d}", manifest)
    facts["rows"] = _rows(facts, counted)
    if counted is not None and shown in counted.maps:
        facts |= _counts(reader, counted, shown, facts)
    elif counted is not None and shown is not None:
        reader.missing.append(f"The frames of map {shown} are not whole in the recording, so it has no counts.")
    elif not recorded:
        reader.missing.append(_without_frames(manifest))
    facts["model"] = reader.get("calibration", lambda: _model(folder, manifest), "the calibration")
    if facts["model"] is None and (manifest.get("calibration") or {}).get("id"):
        reader.missing.append("The calibration is neither in the run nor where its config says, or has changed since.")
    return RunFacts(folder, manifest, summary, recorded, missing=tuple(dict.fromkeys(reader.missing)), **facts)


class _Reader:
    """Reads files, and keeps a sentence for each that is missing or damaged."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.missing: list[str] = []

    def get(self, name: str, read: Callable[[], Read], what: str) -> Read | None:
        """The result of `read`; None if that is not possible. name: of the file, to be checked."""
        try:
            return read()
        except FileNotFoundError:
            self.missing.append(f"There is no {name} ({what}).")
        except (OSError, ValueError, KeyError, RigError, DeviceError, CalibrationError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            reason = reason.removeprefix(f"{name} cannot be read: ").rstrip(".")
            self.missing.append(f"{what.capitalize()} cannot be read: {reason}.")
        return None

    def file(self, name: str, read: Callable[[Path], Read], what: str) -> Read | None:
        """A file of the run."""
        return self.get(name, lambda: read(self.folder / name), what)


def _map_files(reader: _Reader, name: str, manifest: Mapping[str, Any]) -> dict[str, Any]:
    """All that is known of a map."""
    found: dict[str, Any] = {"stripe": reader.file(f"stripe/{name}.npz", read_stripe, "the stripe table") or {}}
    if (reader.folder / "depth").is_dir():
        found["depth_m"] = reader.file(f"depth/{name}.npy", read_depth, "the depth map")
        worth = reader.file(f"confidence/{name}.npz", read_arrays, "confidence and error of each pixel") or {}
        for key in ("confidence", "depth_sd_m"):
            if key in worth:
                found[key] = worth[key]
    else:
        reader.missing.append("Without a calibration there is no depth.")
    found["counts"] = reader.file(f"intensity/{name}.png", read_grey, "the picture of the counts")
    if (reader.folder / "truth").is_dir():
        found["truth"] = reader.file(f"truth/{name}.npz", read_arrays, "the truth") or {}
    elif ((manifest.get("config") or {}).get("world")) is None:
        reader.missing.append("No truth is known, as with any real scene, so errors are those that the map states.")
    else:
        reader.missing.append("The simulated world's truth was not written.")
    return found


def _rows(found: Mapping[str, Any], counted: MapRows | None) -> tuple[int, ...]:
    """Rows whose profiles are shown, evenly spread over the picture."""
    stripe = found.get("stripe") or {}
    height = len(stripe["x_px"]) if "x_px" in stripe else 0 if counted is None else counted.plan.rows
    return tuple(dict.fromkeys(int((i + 0.5) * height / ROWS) for i in range(ROWS))) if height else ()


def _counted_maps(folder: Path, reader: _Reader) -> MapRows | None:
    counted = reader.get("frames", lambda: MapRows(folder), "the recording's frames")
    if counted is not None and counted.problems:
        first = counted.problems[0].rstrip(".")
        reader.missing.append(f"The recording is damaged, rig verify tells more ({len(counted.problems)}: {first}).")
    return counted


def _counts(reader: _Reader, counted: MapRows, number: int, found: Mapping[str, Any]) -> dict[str, Any]:
    """Counts of the shown rows, and their sum over all frames if the run has no picture of it."""

    def read() -> dict[str, Any]:
        rows = {row: counted.row(number, row) for row in found["rows"]}
        extra: dict[str, Any] = {"counted": rows, "near_is_left": counted.geometry.near_is_left}
        if found.get("counts") is None:
            extra["counts"] = intensity_picture(counted.summed(number))
        return extra

    return reader.get("frames", read, "the recording's frames") or {}


def _without_frames(manifest: Mapping[str, Any]) -> str:
    """The reason why rows have no counts, where the frames do not lie in the run's folder."""
    parts = [part.get("folder") for part in (manifest.get("on_request") or {}).get("parts") or ()]
    if not parts:
        return "The frames were not recorded, so rows are shown without their counts."
    named = f"{parts[0]} and {len(parts) - 1} more parts" if len(parts) > 1 else parts[0]
    return f"The frames were recorded in {named}, of which rig report makes pages; here rows are without their counts."


def _model(folder: Path, manifest: Mapping[str, Any]) -> RigModel | None:
    """The calibration of a run: its own, or the file that its config names if that is still the same one."""
    wanted = (manifest.get("calibration") or {}).get("id")
    own = folder / CALIBRATION_FILE
    if own.exists():
        return load_rig_model(own)
    named = (manifest.get("config") or {}).get("calibration")
    if wanted is None or not isinstance(named, str) or not Path(named).exists():
        return None
    model = load_rig_model(named)
    return model if model.fingerprint() == wanted else None


def _manifest(file: Path) -> dict[str, Any]:
    content = read_manifest(file.parent)
    if content is None:
        raise FileNotFoundError(file)
    return content


def _summary(file: Path) -> Mapping[str, Any]:
    if not file.exists():
        raise FileNotFoundError(file)
    return read_summary(file.parent)


def _moment(text: object) -> datetime | None:
    try:
        moment = datetime.fromisoformat(str(text))
    except ValueError:
        return None
    return moment if moment.tzinfo is not None else None
