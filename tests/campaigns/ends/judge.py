"""What is left after a command has ended: on the disk, on the terminal, and among the processes."""

import contextlib
import hashlib
import io
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rig.cli.main import main
from tests.campaigns.ends.process import Lines

TRACES = (
    "Traceback", "Exception ignored", "excepthook", "resource_tracker", "Fatal Python error", "terminate called",
    "Segmentation fault", "the program failed", "Exception in thread", "Warning:",
)  # fmt: skip
"""Words that no user should see."""
_ERROR = re.compile(r"^error: ")


def checksums(folder: Path) -> dict[str, str]:
    """SHA-256 of all files in a folder by their relative paths."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def asked(*arguments: object) -> tuple[int, str]:
    """Exit code and output of a command of `rig`, called here and now."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        try:
            main([str(each) for each in arguments])
        except SystemExit as end:
            return int(end.code or 0), out.getvalue()
    return 0, out.getvalue()


def wrong_words(lines: Lines, code: int | None, json_asked: bool, whole_output: bool) -> Iterator[str]:
    """What is wrong with what the command said. whole_output: whether all of it could be read."""
    said = lines.out + lines.err
    traces = [line for line in said if any(word in line for word in TRACES)]
    if traces:
        yield f"says {traces[0]!r} ... {said[-1]!r}"
    errors = [line for line in said if _ERROR.match(line)]
    if len(set(errors)) < len(errors):
        yield f"says twice {errors[0]!r}"
    if not whole_output:
        return
    if code not in (0, 1) and code is not None and code > 0 and not said:
        yield f"ends with {code} and says nothing"
    if code == 4 and not any("abort" in line for line in said):
        yield f"ends with 4, and does not say that it was aborted: {said[-3:]}"
    if code in (2, 3) and not errors and not json_asked and not any("abort" in line for line in said):
        yield f"ends with {code} without an error: {said[-3:]}"
    if json_asked and code is not None and code >= 0 and lines.err is not lines.out:
        try:
            json.loads("\n".join(lines.out))
        except ValueError:
            yield f"prints no JSON object: {lines.out[:2]}"


def hidden(folder: Path) -> list[str]:
    """Hidden files and folders that were left behind."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob(".*"))


def run_folders(folder: Path) -> list[Path]:
    """Folders that look like a run, or like a part of one."""
    marks = ("manifest.json", "summary.json", "depth", "frames.idx", "stripe")
    return sorted({path.parent for mark in marks for path in folder.rglob(mark) if path.parent.name != "usual"})


def wrong_runs(folder: Path, usual: Path, prefix: bool, torn: bool = False) -> Iterator[str]:
    """What is wrong with the runs that were left in a folder.

    usual: what the command leaves if nothing ends it. prefix: whether what was recorded must be its beginning. torn:
    whether the recordings were not intact before either.
    """
    for run in run_folders(folder):
        name = str(run.relative_to(folder))
        depths = sorted((run / "depth").glob("*.npy")) if (run / "depth").is_dir() else []
        yield from (f"{name}: {why}" for why in _wrong_maps(run, depths, usual / run.relative_to(folder)))
        if not (run / "manifest.json").exists() and not (run / "summary.json").exists():
            yield f"{name}: {sorted(path.name for path in run.iterdir())} without manifest or summary"
            continue
        recorded = any(run.glob("frames-*.spb*"))
        inside = (run.parent / "manifest.json").exists()  # a part, which is not listed beside its run
        if (run / "manifest.json").exists() and not torn and not inside:
            yield from (f"{name}: {why}" for why in _wrong_listing(run))
        code, _ = asked("report", run, "--out", folder.parent / "judged.html")
        if code != 0 and (depths or recorded):
            yield f"{name}: rig report ends with {code}"
        if recorded and not torn:
            yield from (f"{name}: {why}" for why in _wrong_recording(run, usual / run.relative_to(folder), prefix))


def _wrong_maps(run: Path, depths: Sequence[Path], usual: Path) -> Iterator[str]:
    summary = _json(run / "summary.json")
    if depths and summary is None:
        yield f"{len(depths)} depth maps without a summary"
    if summary is not None and "maps" in summary and depths and summary["maps"] < len(depths):
        yield f"{len(depths)} depth maps, but the summary has {summary['maps']}"
    if summary is not None and summary.get("verdict") == "complete" and not (run / "manifest.json").exists():
        yield "complete without a manifest"
    for path in depths:
        try:
            depth = np.load(path)
        except (ValueError, OSError) as error:
            yield f"{path.name} cannot be read: {error}"
            continue
        same = usual / "depth" / path.name
        if same.exists() and not np.array_equal(depth, np.load(same), equal_nan=True):
            yield f"{path.name} differs from that of a run that nothing ended"


def _wrong_listing(run: Path) -> Iterator[str]:
    code, out = asked("runs", run.parent, "--json")
    found = [each for each in json.loads(out or "{}").get("runs", []) if Path(each["folder"]).name == run.name]
    if code != 0 or len(found) != 1:
        yield f"rig runs ends with {code} and lists it {len(found)} times"
    elif found[0]["verdict"] in ("damaged", "recording") or found[0]["problem"]:
        yield f"rig runs calls it {found[0]['verdict']}: {found[0]['problem']}"


def _wrong_recording(run: Path, usual: Path, prefix: bool) -> Iterator[str]:
    code, out = asked("verify", run, "--json")
    verdict = json.loads(out).get("verdict")
    if code != 0 or verdict != "intact":
        yield f"rig verify ends with {code}: {verdict} {json.loads(out).get('problems')}"
    code, out = asked("info", run, "--json")
    if code != 0:
        yield f"rig info ends with {code}: {out[:200]}"
    if prefix and usual.exists() and (frames := frames_of(run)) is not None:
        all_frames = frames_of(usual, run.parent.parent / f"usual-{run.name}")
        # How many blocks follow the last map depends on the moment at which the source is stopped.
        if all_frames is None or any((each != other).any() for each, other in zip(frames, all_frames, strict=False)):
            yield f"its {len(frames)} frames are not the first of those of a run that nothing ended"


def frames_of(run: Path, to: Path | None = None) -> "np.ndarray[Any, Any] | None":
    """The frames of a recording, as `rig export` gives them in the folder `to`."""
    to = to or run.parent.parent / f"exported-{run.name}"
    if not (to / "frames.npy").exists():
        code, _ = asked("export", run, "npy", "--out", to)
        if code != 0:
            return None
    return np.load(to / "frames.npy")  # type: ignore[no-any-return]


def _json(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None
