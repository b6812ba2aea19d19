"""Lists the runs in a folder: when each was taken, with what, and what came of it (`rig runs`).

Only manifests, summaries and the names and sizes of files are read. A run whose files are damaged is listed with the
reason, so that one bad folder hides no good one.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

from drivers.json_text import parse_json
from drivers.recorded.contents import INDEX_FILE
from drivers.units import parse_quantity
from rig.errors import DamagedRecordingError, UsageError
from rig.requests import RunsRequest
from rig.run_folder.manifest import MANIFEST, UNFINISHED, RunVerdict, read_manifest

SUMMARY: Final = "summary.json"
DAMAGED: Final = "damaged"
"""Verdict shown for a run whose manifest or summary cannot be trusted."""
MOST_NOTE: Final = 2000
MOST_TAG: Final = 60
"""Most characters of a note, and of a tag."""
MOST_DEPTH: Final = 3
"""Levels of folders below the named one that are searched for runs."""
VERDICTS: Final = (*(verdict.value for verdict in RunVerdict), UNFINISHED, DAMAGED)


@dataclass(frozen=True, slots=True)
class RunEntry:
    """One run of a list. A text is empty, and a number None, where the run does not say.

    taken: date and time at which the run began, in UTC; if the run does not say, the time of its newest file. verdict:
    one of `VERDICTS`. command: `scan`, `replay`, `reconstruct`, `cut` or `import`. config: its name. scene: that of a
    simulated rig. recorded: whether the frames are in the folder too. bytes: size of all its files. problem: why the
    run is `damaged`.
    """

    folder: Path
    taken: datetime
    verdict: str
    command: str
    config: str
    scene: str
    estimator: str
    exposures: int | None
    maps: int | None
    note: str
    tags: tuple[str, ...]
    recorded: bool
    bytes: int
    problem: str = ""


def list_runs(folder: Path, request: RunsRequest) -> list[RunEntry]:
    """The runs in a folder and up to MOST_DEPTH levels below it, the oldest first, that pass all filters of the
    request. Maps that were made later of the same frames follow their scan.

    Raises UsageError if there is no such folder, or for a filter that cannot be read.
    """
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "does not exist"
        raise UsageError(f"{folder} {what}; name the folder that holds the runs, such as . for this one")
    if request.verdict is not None and request.verdict not in VERDICTS:
        raise UsageError(f"`verdict` is {request.verdict!r}; write one of {', '.join(VERDICTS)}")
    since = None if request.since is None else since_when(request.since, datetime.now(UTC))
    entries = [_entry(run) for run in _runs_below(folder, MOST_DEPTH)]
    kept = [(entry, newest) for entry, newest in entries if _passes(entry, request, since)]
    # Maps that were made later of a scan's frames have the scan's time.
    kept.sort(key=lambda each: (each[0].taken, each[0].command != "scan", each[1], each[0].folder))
    return [entry for entry, _ in kept]


def since_when(text: str, now: datetime) -> datetime:
    """The moment in UTC that a text means: a date, a date and time (local unless it has an offset), or an age such as
    '7 d'.

    now: the moment from which an age counts back. Raises UsageError for any other text.
    """
    try:
        return datetime.fromisoformat(text).astimezone(UTC)
    except (ValueError, OverflowError):
        pass
    try:
        return now - timedelta(seconds=parse_quantity(text, "age"))
    except (ValueError, OverflowError):
        raise UsageError(
            f"`since` is {text!r}; write a date '2025-11-29', a time '2025-11-29 14:00' or an age '7 d'"
        ) from None


def _passes(entry: RunEntry, request: RunsRequest, since: datetime | None) -> bool:
    scene = Path(entry.scene)  # a file's, or the name of a bundled one
    wanted = (
        (request.verdict, (entry.verdict,)),
        (request.config, (entry.config,)),
        (request.scene, (entry.scene, scene.name, scene.stem)),
        (request.estimator, (entry.estimator,)),
    )
    return (
        all(asked is None or asked in found for asked, found in wanted)
        and set(request.tags) <= set(entry.tags)
        and (request.note is None or request.note.lower() in entry.note.lower())
        and (since is None or entry.taken >= since)
    )


def _runs_below(folder: Path, depth: int) -> Iterator[Path]:
    """Folders with a run. What lies in a run is not looked at; nor are hidden folders and links."""
    if is_run(folder):
        yield folder
        return
    if depth == 0:
        return
    try:
        below = sorted(part for part in folder.iterdir() if part.is_dir() and not part.is_symlink())
    except OSError:
        return
    for part in below:
        if not part.name.startswith("."):
            yield from _runs_below(part, depth - 1)


def is_run(folder: Path) -> bool:
    """Whether a folder is that of a run: it has a manifest, a summary beside maps, or frames."""
    return any((folder / name).exists() for name in (MANIFEST, INDEX_FILE)) or (
        (folder / SUMMARY).exists() and (folder / "stripe").is_dir()
    )


def _entry(folder: Path) -> tuple[RunEntry, datetime]:
    """The line of a list for a run, and the time of its newest file."""
    manifest: Mapping[str, Any] = {}
    summary: Mapping[str, Any] = {}
    problem = ""
    try:
        manifest = read_manifest(folder) or {}
        problem = "" if manifest else f"{MANIFEST} is missing"
        summary = read_summary(folder)
    except DamagedRecordingError as error:
        problem = str(error).partition(";")[0]
    size, newest = _size_and_time(folder)
    config = manifest.get("config") or {}
    entry = RunEntry(
        folder=folder,
        taken=_taken(manifest) or newest,
        verdict=DAMAGED if problem else str(manifest.get("verdict") or DAMAGED),
        command=str(manifest.get("command") or ""),
        config=str(config.get("name") or ""),
        scene=str((config.get("world") or {}).get("scene") or ""),
        estimator=str(summary.get("estimator") or (config.get("estimate") or {}).get("estimator") or ""),
        exposures=_whole((config.get("scan") or {}).get("exposures")),
        maps=_whole(summary.get("maps")),
        note=str(manifest.get("note") or ""),
        tags=tuple(map(str, manifest.get("tags") or ())),
        recorded=(folder / INDEX_FILE).exists(),
        bytes=size,
        problem=problem,
    )
    return entry, newest


def read_summary(folder: Path) -> Mapping[str, Any]:
    """The summary of a run; empty if there is none, as while the run goes on. Raises DamagedRecordingError if it cannot
    be read."""
    try:
        content = parse_json((folder / SUMMARY).read_bytes())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise DamagedRecordingError(f"{SUMMARY} cannot be read: {str(error).partition(chr(10))[0]}") from error
    if not isinstance(content, dict):
        raise DamagedRecordingError(f"{SUMMARY} is no summary of a run")
    return content


def _taken(manifest: Mapping[str, Any]) -> datetime | None:
    try:
        return datetime.fromisoformat(str((manifest.get("rig") or {}).get("taken"))).astimezone(UTC)
    except (ValueError, OverflowError):  # the second at the ends of the calendar
        return None


def _size_and_time(folder: Path) -> tuple[int, datetime]:
    """Bytes of all files below a folder, and the time at which the newest was written."""
    size, newest_s = 0, 0.0
    for parent, _, names in os.walk(folder):
        for name in names:
            try:
                found = os.stat(os.path.join(parent, name))
            except OSError:  # a run that goes on renames its files
                continue
            size, newest_s = size + found.st_size, max(newest_s, found.st_mtime)
    return size, datetime.fromtimestamp(newest_s or folder.stat().st_mtime, UTC)


def _whole(value: object) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def label_problems(note: str | None, tags: Sequence[str]) -> list[str]:
    """One line for each problem with the note and the tags of a run."""
    problems = []
    if note is not None and (len(note) > MOST_NOTE or not note.strip()):
        size = f"has {len(note)} characters" if note.strip() else "is empty"
        problems.append(f"`note` {size}; write 1 to {MOST_NOTE}, or leave it out")
    for tag in tags:
        if not (0 < len(tag) <= MOST_TAG and tag.isprintable() and tag == tag.strip() and "," not in tag):
            shown = tag if len(tag) <= MOST_TAG else f"{tag[:MOST_TAG]}..."
            problems.append(f"tag {shown!r} is no tag; write 1 to {MOST_TAG} printable characters without a comma")
    return problems
