"""The folder of a run: every output in one place.

    depth/000000.npy  depth/000000.png  confidence/000000.npz  confidence/000000.png
    intensity/000000.png  stripe/000000.npz  cloud/000000.ply
    learned/000000.npz (the state used for the map, if the estimator learns)
    truth/000000.npz (if a world knows it)  manifest.json  summary.json

A new folder is complete when it appears: everything is written to a hidden folder beside it, which is renamed at the
end. If the folder exists and is empty, it is filled at the end, file by file, summary.json last. The folder of a
recording is there from the start and grows in place. Data written with `replace_file`, then `sync_folder`, survives a
loss of power.
"""

import contextlib
import io
import logging
import os
import re
import secrets
import shutil
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from calibration.files.npy_files import load_arrays
from drivers.interfaces import SweepTruth
from drivers.recorded.contents import INDEX_FILE
from rig.depth.reconstruct import MapResult
from rig.errors import UsageError
from rig.estimate.registry import Learned
from rig.estimate.row.model import RowModel
from rig.run_folder.disk import CLAIM_FILE, is_held, replace_file, sync_folder
from rig.run_folder.manifest import MANIFEST, sealed_text
from rig.run_folder.pictures import (
    cloud,
    confidence_picture,
    depth_limits,
    depth_picture,
    intensity_picture,
    ply_bytes,
    png_bytes,
)
from rig.run_folder.plain_json import json_text

_log = logging.getLogger(__name__)

Rays = tuple[NDArray[np.floating], NDArray[np.floating]]


class RunFolder:
    """Collects the outputs of a run. `publish` makes them appear as `path`; if not published or kept, they are removed.

    in_place: whether the outputs can be seen at `path` from the start.
    Raises UsageError, with one line, if `path` is a file or a folder that is not empty, or if it cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], *, in_place: bool = False) -> None:
        """Claim the folder. If it grows in place it now exists, with a hidden file; else nothing is visible at `path`
        yet."""
        self.path = Path(path).absolute()
        self._in_place = in_place
        self._limits: tuple[float, float] | None = None
        self._files: set[str] = set()
        """Names of the files written beside the maps; those of maps may be millions, and are only counted."""
        self._of_maps = Counter[str]()
        """Number of files in each folder of maps."""
        self._made_parents: list[Path] = []
        self._scratch: Path | None = None
        try:
            self._scratch = self._claim()
        except OSError as error:
            self.discard()
            raise _unwritable(self.path, error) from error

    def __enter__(self) -> Self:
        """The folder itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove what was not published."""
        self.discard()

    def write_map(self, index: int, result: MapResult, rays: Rays | None) -> None:
        """Write all files of one map. rays: (u, v) of the camera; None for an uncalibrated rig, without depth,
        confidence and cloud.

        If a file cannot be written (disk full), the map's other files are removed too, and UsageError says why.
        """
        name = f"{index:06d}"
        files = {
            f"intensity/{name}.png": png_bytes(intensity_picture(result.intensity)),
            f"stripe/{name}.npz": _npz_bytes(result.stripe.arrays()),
        }
        if result.learned is not None:
            files[f"learned/{name}.npz"] = _npz_bytes(result.learned.arrays())
        if rays is not None:
            # The first map sets the colours of all, so that a film of them does not flicker.
            self._limits = self._limits or depth_limits(result.depth_m)
            depth = io.BytesIO()
            np.save(depth, result.depth_m, allow_pickle=False)
            files[f"depth/{name}.npy"] = depth.getvalue()
            files[f"depth/{name}.png"] = png_bytes(depth_picture(result.depth_m, self._limits))
            # Three digits are more than is known of either, and half as many bytes.
            worth = {"confidence": result.confidence, "depth_sd_m": result.depth_sd_m}
            files[f"confidence/{name}.npz"] = _npz_bytes({key: each.astype(np.float16) for key, each in worth.items()})
            files[f"confidence/{name}.png"] = png_bytes(confidence_picture(result.confidence))
            files[f"cloud/{name}.ply"] = ply_bytes(cloud(result.depth_m, *rays, result.intensity))
        self._write(files)

    def place(self, name: str) -> Path:
        """Path at which to write a file of the run. Close the file before `publish`. "" is the folder itself."""
        assert self._scratch is not None, "the run folder is published or discarded already"
        return self._scratch / name

    def write_truth(self, index: int, truth: SweepTruth) -> None:
        """Write the world's truth for the sweep of a map. Raises UsageError as `write_map` does."""
        self._write({f"truth/{index:06d}.npz": _npz_bytes({"x_px": truth.x_px, "depth_m": truth.depth_m})})

    def remove_map(self, index: int) -> None:
        """Remove every file of a map that was not finished."""
        for file in self.place("").glob(f"*/{index:06d}.*"):
            self._of_maps[file.parent.name] -= 1
            file.unlink(missing_ok=True)

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Write `name` (manifest.json, summary.json) as strict JSON, the manifest with a checksum. A reader sees either
        the old file or the new one. Raises UsageError if it cannot be written."""
        text = json_text(content)
        text = sealed_text(text) if name == MANIFEST else text
        file = self.place(name)
        try:
            replace_file(file, (text + "\n").encode())
            if self._in_place:
                sync_folder(file.parent)
        except OSError as error:
            raise _unwritable(self.path, error) from error
        self._files.add(name)

    def write_text(self, name: str, text: str) -> None:
        """Write a file of text. Raises UsageError as `write_map` does."""
        self._write({name: text.encode()})

    def keep(self) -> None:
        """Keep everything as it is, even if the run does not come to its end. Only for a folder that grows in place."""
        assert self._in_place, "a run folder that is no recording appears whole or not at all"
        (self.path / CLAIM_FILE).unlink(missing_ok=True)
        self._scratch = None
        self._made_parents.clear()

    def publish(self) -> Path:
        """Make the folder appear and return its path: `path`, or a name with -2, -3, ... added if `path` was taken
        while the run went on. Raises UsageError if that fails, or if files that were written have gone."""
        scratch = self._scratch
        assert scratch is not None, "a run folder is published once"
        try:
            published = self._move(scratch)
        except OSError as error:
            raise _unwritable(self.path, error) from error
        self._scratch = None
        self._made_parents.clear()
        self._require_whole(published)
        if published != self.path:
            _log.warning("%s was taken while the run went on; the run is in %s", self.path, published)
        return published

    def _require_whole(self, folder: Path) -> None:
        """Raise UsageError if somebody has removed or renamed what was written to the folder."""
        gone = sorted(name for name in self._files if not (folder / name).exists())
        for name, number in sorted(self._of_maps.items()):
            try:
                found = len(os.listdir(folder / name)) if number > 0 else 0
            except OSError:
                found = 0
            gone += [f"{number - found} of {number} files of {name}"] if found < number else []
        if gone:
            raise UsageError(
                f"{folder} lacks {', '.join(gone)}: somebody removed them while the folder was written; do it again"
            )

    def _move(self, scratch: Path) -> Path:
        if self._in_place:
            (self.path / CLAIM_FILE).unlink(missing_ok=True)
            return self.path
        if scratch.parent == self.path:  # an empty folder was given: fill it, summary.json last
            if list(self.path.iterdir()) == [scratch]:
                for child in sorted(scratch.iterdir(), key=lambda file: file.name == "summary.json"):
                    child.rename(self.path / child.name)
                scratch.rmdir()
                return self.path
        elif _renamed(scratch, self.path):
            return self.path
        beside = (self.path.with_name(f"{self.path.name}-{number}") for number in count(2))
        return next(path for path in beside if _renamed(scratch, path))

    def discard(self) -> None:
        """Remove everything that was not published or kept, and the folders made for it."""
        if self._scratch is not None:
            if self._in_place:
                mine = not is_held(self._scratch / INDEX_FILE)  # if it is held, another run took the folder while empty
                for child in self._scratch.iterdir() if mine else ():
                    shutil.rmtree(child, ignore_errors=True) if child.is_dir() else child.unlink(missing_ok=True)
            else:
                shutil.rmtree(self._scratch, ignore_errors=True)
            self._scratch = None
        for parent in reversed(self._made_parents):
            try:
                parent.rmdir()
            except OSError:
                break  # somebody else has put something there meanwhile
        self._made_parents.clear()

    def _claim(self) -> Path:
        there = self.path.exists()
        if there and not self.path.is_dir():
            raise UsageError(f"`out={self.path}` is a file; name a new folder")
        if there and any(self.path.iterdir()):
            raise _taken(self.path)
        missing = [folder for folder in self.path.parents if not folder.exists()]
        for folder in [*reversed(missing), *([self.path] if self._in_place and not there else ())]:
            with contextlib.suppress(FileExistsError):  # another run has just made it
                folder.mkdir()
                self._made_parents.append(folder)
        if self._in_place:
            try:
                (self.path / CLAIM_FILE).open("xb").close()
            except FileExistsError:  # another run has found it empty, too
                self.discard()
                raise _taken(self.path) from None
            return self.path
        scratch = (self.path if there else self.path.parent) / f".{self.path.name}.{secrets.token_hex(4)}.part"
        scratch.mkdir()
        return scratch

    def _write(self, files: Mapping[str, bytes]) -> None:
        written: list[Path] = []
        try:
            for name, data in files.items():
                file = self.place(name)
                if file.parent != self.place(""):  # that one is there, unless somebody removed it with all in it
                    file.parent.mkdir(exist_ok=True)
                written.append(file)
                file.write_bytes(data)
        except BaseException as error:  # an interrupt too leaves no half of a map
            for file in written:
                file.unlink(missing_ok=True)
            if isinstance(error, OSError):
                raise _unwritable(self.path, error) from error
            raise
        for name in files:
            folder, _, in_it = name.rpartition("/")
            if folder:
                self._of_maps[folder] += 1
            else:
                self._files.add(in_it)


@dataclass(frozen=True, slots=True)
class SavePolicy:
    """The maps of a run that are written (`save`). step: maps 0, step, 2 step, ...; None: only the last."""

    step: int | None = 1

    @classmethod
    def parse(cls, text: str) -> "SavePolicy":
        """Parse "all", "last" or "every 5", also "every=5" or "every:5". Raises UsageError for anything else."""
        match = re.fullmatch(r"(all)|(last)|every[\s:=]+0*([1-9]\d*)", text.strip().lower(), re.ASCII)
        if match is None:
            raise UsageError(f"`save` is {text!r}; write 'all', 'last' or 'every N' with N of 1 or more")
        return cls(None if match[2] else int(match[3] or 1))

    def count(self, maps: int) -> int:
        """Number of maps that are written in a run of `maps` maps."""
        return min(maps, 1) if self.step is None else -(-maps // self.step)

    def keeps(self, index: int) -> bool:
        """Whether map `index` is written as soon as it is ready. False for all if only the last one is written."""
        return self.step is not None and index % self.step == 0


def _renamed(folder: Path, target: Path) -> bool:
    """Move a folder; False if `target` exists, even as an empty folder: another run may have claimed it. Raises OSError
    if anything else prevents the move."""
    if target.exists():
        return False
    try:
        folder.rename(target)
    except OSError:
        if not target.exists():
            raise
        return False
    return True


def _taken(path: Path) -> UsageError:
    return UsageError(f"`out={path}` exists and is not empty; name a new folder or empty this one")


def _unwritable(path: Path, error: OSError) -> UsageError:
    reason = error.strerror or str(error)
    return UsageError(f"cannot write {path}: {reason}; name another folder as `out` or free the space it needs")


def write_learned(file: Path, state: Learned) -> None:
    """Write a learned state, without the labels of its last map, as `replace_file` does. Raises OSError."""
    replace_file(file, _npz_bytes({name: value for name, value in state.arrays().items() if name != "before"}))


def read_learned(file: Path) -> RowModel:
    """The learned state in a file. Raises UsageError if the file is missing or holds none."""
    try:
        return RowModel.from_arrays(load_arrays(file))
    except (OSError, ValueError, KeyError) as error:
        what = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        raise UsageError(
            f"{file} holds nothing that joint has learned ({what}); remove it, or name another file"
        ) from error


def _npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **arrays)
    return stream.getvalue()
