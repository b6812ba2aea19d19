"""Decides whether a calibration may be used: whether it is of this rig, passed its checks, and is not too old.

A measured calibration states its devices, its date and its verdict (`Identity`). One written by hand states
none of these and is not compared. Everything that affects depth is compared: kinds and serial numbers of sensor and
scanner, how they are mounted, and the laser lines; for a simulated rig, its geometry. Settings of a scan are not
compared. A recording's calibration is compared with the devices and the date of the recording.

Each reason against a calibration is a `Refusal`, which the user may accept. The outcome of a later check is noted in a
file beside the calibration (`note_check`, `notes_on`); the calibration itself stays as it is.
"""

import hashlib
import json
import logging
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.files.rig_file import CALIBRATION_FILE, load_rig_model
from calibration.model.rig_model import Identity, RigModel
from drivers.json_text import parse_json
from drivers.replay.spad import ReplaySpad
from rig.devices.open import OpenRig
from rig.errors import UsageError
from rig.recording.inputs import read_plan
from rig.run_folder.disk import replace_file
from rig.run_folder.manifest import read_manifest

_log = logging.getLogger(__name__)

NEXT: Final = "calibrate again, or add `accept_calibration=True` to use it all the same"


@dataclass(frozen=True, slots=True)
class Refusal:
    """One reason not to use a calibration, for a rig or for a camera alone.

    code: other-spad, other-scanner, other-world, other-lines, other-depth, failed-verdict, failed-check or too-old.
    """

    code: str
    text: str

    def __str__(self) -> str:
        """The reason in one line, as summaries have it."""
        return f"{self.code}: {self.text}"


DAY_S: Final = 86400.0
SAME_DEPTH: Final = 0.01
"""Largest relative difference between the depths of two calibrations that count as the same."""
COMPARED_PX: Final = 24
"""Rows, columns of pixels and mirror commands at which two calibrations are compared, of each."""
_SLOTS: Final = ("spad", "scanner")
"""Devices that depth depends on: laser and sync source only let the light out."""
_NO_SERIAL: Final = ("", "none")
_GEOMETRY: Final = "geometry"
"""Key of a digest of a simulated rig's true geometry. The key `world` has only the name of the geometry's file."""
_CHECKS: Final = {"check": "rig calibrate check", "pixels": "rig calibrate pixels"}


@runtime_checkable
class KnowsRig(Protocol):
    """A world that knows the true rig."""

    def true_model(self) -> RigModel:
        """The true camera, scanner and lag, which a calibration should find."""
        ...


@dataclass(frozen=True, slots=True)
class CalibrationUse:
    """The calibration of a run. checked: whether it states its rig, without which nothing can be compared. accepted:
    reasons against it that the user accepted."""

    model: RigModel
    checked: bool
    accepted: tuple[Refusal, ...] = ()

    def content(self) -> dict[str, Any]:
        """The calibration's use as plain values for the manifest."""
        return {
            "id": self.model.fingerprint(),
            "provenance": dict(self.model.provenance),
            **check_content("matches" if self.checked else "unchecked", self.accepted),
        }


def identity_of(rig: OpenRig) -> Identity:
    """Identity of an open rig, with the present date.

    A rig that plays a recording has the identity and the date of the recorded rig; what `recorded_identity` raises is
    then raised here too.
    """
    if isinstance(rig.spad, ReplaySpad):
        return recorded_identity(rig.spad.recording.path)
    config, info = rig.config, rig.spad.info
    scanner = config.scanner
    kinds = {
        "spad": f"{config.spad.kind}, {info.width} x {info.height} px, turned by {info.rotation_deg} degrees",
        "scanner": f"{scanner.kind}, axis {getattr(scanner, 'axis', 'x')}",
        "lines": ", ".join(f"{offset:g}" for offset in config.line_offsets),
    }
    world = {} if config.world is None else dict(config.world)
    if "geometry" in world:  # of a simulated rig: as it really is
        kinds["world"] = Path(str(world["geometry"] or "bundled")).name
    if isinstance(rig.world, KnowsRig):
        kinds[_GEOMETRY] = replace(rig.world.true_model(), defects=None).fingerprint()
    serials = {slot: serial for slot in _SLOTS if (serial := getattr(rig, slot).serial) and serial not in _NO_SERIAL}
    return _identity(config.name, kinds, serials, datetime.now(UTC).isoformat(timespec="seconds"))


def recorded_identity(run: Path) -> Identity:
    """Identity of the rig that made a recording, as far as its manifest says; `created` is the recording's date. Raises
    DamagedRecordingError if the manifest is damaged."""
    noted = (read_manifest(run) or {}).get("rig") or {}
    kinds, serials = noted.get("kinds") or {}, noted.get("serials") or {}
    return _identity(str(noted.get("name", "")), kinds, serials, str(noted.get("taken", "")))


def same_rig(one: Identity, other: Identity) -> bool:
    """Whether two identities are of one rig: whether their kinds and serial numbers are equal."""
    kinds, others = _comparable(one, other)
    return kinds == others and one.serials == other.serials


def rig_content(identity: Identity) -> dict[str, Any]:
    """The rig of a run as plain values for its manifest; `recorded_identity` reads it."""
    return {
        "name": identity.name,
        "id": identity.rig,
        "kinds": dict(identity.kinds),
        "serials": dict(identity.serials),
        "taken": identity.created,
    }


def calibration_use(rig: OpenRig, *, accept: bool = False, here: Identity | None = None) -> CalibrationUse | None:
    """The calibration of an open rig, after comparison with the rig; None if the rig has none. Raises UsageError with a
    line for each reason against it.

    accept: whether to use it in spite of the reasons. here: the rig's identity, if the caller has it. Reasons that
    were accepted when a recording was taken stay accepted for the recording's own calibration.
    """
    if rig.model is None:
        return None
    here = here or identity_of(rig)
    found = refusals(rig.model, rig.config.calibration, here, rig.config.calibration_max_age) + _other_depth(rig)
    return _used(rig.model, rig.config.calibration, found, accept, _accepted_before(rig))


def cube_calibration_use(model: RigModel, file: Path | None, *, accept: bool = False) -> CalibrationUse:
    """The calibration of a cube of frames whose rig is unknown: only the calibration's verdict and noted checks count.
    Raises UsageError as `calibration_use` does.
    """
    return replace(_used(model, file, refusals(model, file, None), accept), checked=False)


def refusals(
    model: RigModel, file: Path | None, here: Identity | None, max_age_s: float | None = None
) -> tuple[Refusal, ...]:
    """Reasons against a calibration for the rig `here` at the time `here.created`; `here` is None for an unknown rig.
    Raises UsageError if notes on the calibration cannot be read."""
    found: list[Refusal] = []
    identity = model.identity
    if identity is not None:
        if here is not None:
            found += _foreign(identity, here)
            found += _aged(identity, here, max_age_s)
        found += failed_verdict(identity.verdict, identity.reasons)
    for what, note in notes_on(file, model).items():
        if not note.get("passed", True):
            why = ", ".join(note.get("reasons") or ()) or "no reason noted"
            said = f"'{_CHECKS.get(what, what)}' of {note.get('date', 'unknown date')} failed ({why}) since it was made"
            found.append(Refusal("failed-check", said))
    return tuple(found)


def _identity(name: str, kinds: Mapping[str, str], serials: Mapping[str, str], created: str) -> Identity:
    text = json.dumps([sorted(kinds.items()), sorted(serials.items())])
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    return Identity(rig=digest, created=created, name=name, kinds=kinds, serials=serials)


def _used(
    model: RigModel, file: Path | None, found: tuple[Refusal, ...], accept: bool, before: Container[str] = ()
) -> CalibrationUse:
    if not accept:
        require_accepted("calibration" if file is None else f"calibration {file}", found, before)
    return CalibrationUse(model, model.identity is not None, found)


def _foreign(made: Identity, here: Identity) -> list[Refusal]:
    """A reason for each kind or serial number that both identities state and that differs."""
    of = f" of the rig '{made.name}'" if made.name else ""
    found = []
    for what, ours, theirs in (("", *_comparable(made, here)), (" serial number", made.serials, here.serials)):
        for slot in [slot for slot in ours if slot in theirs and ours[slot] != theirs[slot]]:
            said = f"is{of} with {slot}{what} '{ours[slot]}', this rig has '{theirs[slot]}'"
            found.append(Refusal(f"other-{slot}", said))
    return found


def _comparable(made: Identity, here: Identity) -> tuple[dict[str, str], dict[str, str]]:
    """Kinds of both. If both state a digest of a geometry, `world` is that, or name and digest if digests differ."""
    both = dict(made.kinds), dict(here.kinds)
    digests = [kinds.pop(_GEOMETRY, "") for kinds in both]
    if all(digests):
        alike = digests[0] == digests[1]
        for kinds, digest in zip(both, digests, strict=True):
            kinds["world"] = digest if alike else f"{kinds.get('world', '')} ({digest})"
    return both


def _aged(made: Identity, here: Identity, max_age_s: float | None) -> list[Refusal]:
    begun, now = _date(made.created), _date(here.created)
    if max_age_s is None or begun is None or now is None:
        return []
    age_s = (now - begun).total_seconds()
    if age_s <= max_age_s:
        return []
    said = f"was made {_span(age_s)} ago ({made.created}), calibration_max_age is {_span(max_age_s)}"
    return [Refusal("too-old", said)]


def _other_depth(rig: OpenRig) -> tuple[Refusal, ...]:
    """A reason if a calibration that does not state its rig gives other depths than the one with which the played
    recording was taken. One that states the rig may be better, and differ for that reason."""
    file, model = rig.config.calibration, rig.model
    if not isinstance(rig.spad, ReplaySpad) or model is None or model.identity is not None or file is None:
        return ()
    run = rig.spad.recording.path
    before = run / CALIBRATION_FILE
    if file.resolve() == before.resolve() or not before.exists():
        return ()
    try:
        plan, own = read_plan(run), load_rig_model(before)
        ratio = _depth_ratio(own, model, plan.commands, plan.depth_range_m)
    except (CalibrationError, UsageError):
        return ()  # nothing to compare with; what cannot be used is refused elsewhere
    if abs(ratio - 1) <= SAME_DEPTH:
        return ()
    times = f"its depths are {ratio:.3g} times those of the calibration with which {run} was taken"
    said = f"does not state its rig, and {times}"
    return (Refusal("other-depth", said),)


def _depth_ratio(
    own: RigModel, other: RigModel, commands: NDArray[np.float64], depth_range_m: tuple[float, float]
) -> float:
    """Depth by another calibration over that by a recording's own: the pixel and column at which it differs by more
    than at half of all, within the depth range. Negative where the other one has surfaces behind the camera."""
    shape = own.camera.height, own.camera.width
    rows, columns = (np.linspace(0, n - 1, COMPARED_PX).astype(np.int64) for n in shape)
    chosen = np.ix_(rows, columns)
    some = commands[np.linspace(0, len(commands) - 1, COMPARED_PX).astype(np.int64)]

    def inverse(model: RigModel) -> NDArray[np.float64]:
        across, down = (each[chosen].ravel() for each in model.camera.tangents())
        nx, ny, nz, d = model.planes(some).T[:, :, None]
        return np.asarray((nx * across + ny * down + nz) / d)

    mine, theirs = inverse(own), inverse(other)
    near, far = depth_range_m
    inside = (mine >= 1 / far) & (mine <= 1 / near) & np.isfinite(theirs)
    if not inside.any():
        return 1.0
    differs = theirs[inside] / mine[inside]
    middle = differs[np.argsort(np.abs(differs - 1))[len(differs) // 2]]
    return float(1 / middle) if middle else np.inf


def _span(time_s: float) -> str:
    """A time in days, hours or seconds: the largest unit of which it has at least one."""
    units = (("days", DAY_S), ("hours", 3600.0))
    unit, size = next((of for of in units if time_s >= of[1]), ("seconds", 1.0))
    return f"{time_s / size:.4g} {unit}"


def _date(text: str) -> datetime | None:
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        return None
    return found if found.tzinfo is not None else found.replace(tzinfo=UTC)


def _accepted_before(rig: OpenRig) -> frozenset[str]:
    """Codes of the reasons that were accepted for a recording's own calibration when it was taken."""
    file, run = rig.config.calibration, rig.spad.recording.path if isinstance(rig.spad, ReplaySpad) else None
    if file is None or run is None or file.resolve() != (run / CALIBRATION_FILE).resolve():
        return frozenset()
    noted = (read_manifest(run) or {}).get("calibration") or {}
    return frozenset(str(code) for code, _ in noted.get("accepted") or ())


def accepted_by(use: CalibrationUse | None) -> tuple[str, ...]:
    """The accepted reasons against a run's calibration as lines for the summary; empty without a calibration."""
    return () if use is None else tuple(map(str, use.accepted))


def failed_verdict(verdict: str | None, reasons: Sequence[str]) -> list[Refusal]:
    """The reason that follows from a calibration's own verdict; empty if it passed or was not judged (None)."""
    if verdict != "failed":
        return []
    why = ", ".join(reasons) or "no reason noted"
    return [Refusal("failed-verdict", f"its verdict is 'failed' ({why}), 'passed' is needed")]


def require_accepted(name: str, found: Sequence[Refusal], accepted: Container[str]) -> None:
    """Raise UsageError with a line for each reason whose code is not accepted; each line begins with `name`."""
    if refused := [each for each in found if each.code not in accepted]:
        raise UsageError.of(f"{name}: {each.text}; {NEXT}" for each in refused)


def check_content(checked: str, accepted: Sequence[Refusal]) -> dict[str, Any]:
    """The outcome of the comparison for a manifest: 'accepted' with the accepted reasons, or the word `checked` without
    any."""
    if not accepted:
        return {"check": checked}
    return {"check": "accepted", "accepted": [[each.code, each.text] for each in accepted]}


def note_check(file: Path, model: RigModel, what: str, *, passed: bool, reasons: tuple[str, ...] = ()) -> Path:
    """Note the outcome of a check in a file beside the calibration; returns that file's path. what: the command that
    checked, 'check' or 'pixels'. Raises OSError, or UsageError if older notes cannot be read."""
    beside = _beside(file)
    notes = _read_notes(beside)
    date = datetime.now(UTC).isoformat(timespec="seconds")
    notes[what] = {"calibration": model.fingerprint(), "date": date, "passed": passed, "reasons": list(reasons)}
    replace_file(beside, (json.dumps(notes, indent=1) + "\n").encode())
    return beside


def try_note(file: Path, model: RigModel, what: str, *, passed: bool, reasons: tuple[str, ...] = ()) -> bool:
    """Note a check as `note_check` does; returns False, and logs a warning, if the file cannot be written."""
    try:
        note_check(file, model, what, passed=passed, reasons=reasons)
    except OSError as error:
        _log.warning("%s cannot be noted on: %s", file, error.strerror or error)
        return False
    return True


def carry_notes(old: Path, before: RigModel, new: Path, after: RigModel, *, new_pixels: bool = False) -> None:
    """Copy the notes on failed checks from a calibration to the one made from it. Raises what `note_check` raises.

    new_pixels: whether the new one has a pixel map of its own, to which notes on the old pixel map do not apply.
    """
    failed = {what: note for what, note in notes_on(old, before).items() if not note.get("passed", True)}
    if new_pixels:
        failed.pop("pixels", None)
    for what, note in failed.items():
        note_check(new, after, what, passed=False, reasons=tuple(note.get("reasons") or ()))


def _beside(file: Path) -> Path:
    return file.with_name(f"{file.stem}-checks.json")


def notes_on(file: Path | None, model: RigModel) -> dict[str, dict[str, Any]]:
    """Notes on this very calibration, by the name of the check; empty without a file. Raises UsageError if damaged."""
    if file is None:
        return {}
    notes = _read_notes(_beside(file))
    return {what: note for what, note in notes.items() if note.get("calibration") == model.fingerprint()}


def _read_notes(file: Path) -> dict[str, dict[str, Any]]:
    try:
        notes = parse_json(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise UsageError(f"{file} cannot be read ({error}); remove it and check the calibration again") from error
    if not isinstance(notes, dict) or not all(isinstance(note, dict) for note in notes.values()):
        raise UsageError(f"{file} holds no notes on a calibration; remove it and check the calibration again")
    return notes
