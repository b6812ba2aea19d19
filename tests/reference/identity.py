"""Whether results are bit for bit those of another checkout: hashes of everything that commands compute.

    python -m tests.reference.identity make --folder F
    python -m tests.reference.identity check --folder F --write before.json
    python -m tests.reference.identity check --folder F --against before.json

`make` records the scans of `identity_cases.yaml` and writes a bare cube and the views of a calibration; `check`
reconstructs them with every estimator, replays them, scans and calibrates anew, compiles plans, and hashes what comes
out. Only commands (`rig ...`) and files are used, so that modules may move. Hashes differ between machines. With
--against the exit code is 1 where anything differs.
"""

import argparse
import hashlib
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml

from tests.reference.geometry import Geometry
from tests.reference.scene import procedural_scene
from tests.reference.working_point import DENSE, WorkingPoint

Hashes = dict[str, str]
"""By file, or file:member."""
Results = dict[str, dict[str, Hashes]]
"""By case and step."""
Words = Sequence[object]
"""A command, without `rig`."""
Task = tuple[str, str, Callable[[Path], Hashes]]
"""Case, step and what hashes it, given an empty folder."""
Content = dict[str, Any]

RIG = Path(sys.executable).with_name("rig")
ENVIRONMENT = os.environ | {"OPENCV_FOR_THREADS_NUM": "1"}
"""OpenCV 5.0 adds up in the order in which its threads end: `cv2.calibrateCamera` differs in its last bits."""
MOMENTS = {
    "compute_time_s", "realtime_factor", "stages", "rest_s", "wall_s", "replay", "created", "taken", "age_s", "folder",
    "compute_s", "seconds", "id",
}  # fmt: skip
"""Keys whose values go with the time of the day, or that of the computation."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("verb", choices=("make", "check"))
    parser.add_argument("--folder", type=Path, required=True, help="of the recordings")
    parser.add_argument("--write", type=Path, help="file for the hashes")
    parser.add_argument("--against", type=Path, help="file of hashes to compare with")
    parser.add_argument("--only", default="", help="cases whose name holds this text")
    given = parser.parse_args(arguments)
    folder = given.folder.resolve()
    if given.verb == "make":
        make(folder)
        return 0
    results = run([task for task in all_tasks(folder) if given.only in task[0]])
    if given.write is not None:
        given.write.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n")
    if given.against is None:
        return 0
    before = json.loads(given.against.read_text())
    found = differences({name: steps for name, steps in before.items() if given.only in name}, results)
    print("\n".join(found) if found else f"identical with {given.against}")
    return 1 if found else 0


def read_cases() -> dict[str, Content]:
    """Cases by name, those of rigs complete."""
    contents = yaml.safe_load(Path(__file__).with_name("identity_cases.yaml").read_text())
    base = contents.pop("base")
    return {name: _changed(base, case) if "config" in case else case for name, case in contents.items()}


def _changed(content: Content, changes: Mapping[str, Any]) -> Content:
    """The content with these keys added or replaced, those of mappings in it one by one."""
    of_mappings = {key: _changed(content.get(key, {}), each) for key, each in changes.items() if isinstance(each, dict)}
    return {**content, **changes, **of_mappings}


def make(folder: Path) -> None:
    """Write rigs, recordings, the cube and the views of a calibration into a new folder."""
    commands = []
    for name, case in read_cases().items():
        if "record" in case:
            write_rig(case, folder / name)
            commands.append([*words_of(case["record"], folder, name, case), "--out", folder / name / "run"])
    write_cube(folder / "cube")
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for ended, _ in pool.map(partial(rig, folder=folder), commands):
            if ended["exit code"] not in ("0", "1"):
                raise SystemExit(ended["exit code"])


def words_of(line: str, folder: Path, name: str, case: Content) -> list[str]:
    """The words of a command of `identity_cases.yaml`."""
    folders = {"folder": shlex.quote(str(folder)), "case": shlex.quote(str(folder / name))}
    return shlex.split(line.format(name=name, maps=case.get("maps"), **folders))


def write_rig(case: Content, folder: Path) -> None:
    """Write the files of a case's rig. defect_share: of its pixels, which the calibration known.yaml calls defects."""
    folder.mkdir(parents=True)
    files = {part: case[part] for part in ("config", "rig", "scene", "board") if part in case}
    if share := case.get("defect_share"):
        size = case["rig"]["camera"]["height"], case["rig"]["camera"]["width"]
        np.save(folder / "defects.npy", np.random.default_rng(11).random(size) < share)
        files["known"] = case["rig"] | {"defects": "defects.npy"}
    for part, content in files.items():
        (folder / f"{part}.yaml").write_text(yaml.safe_dump(content, sort_keys=False))


def write_cube(folder: Path) -> None:
    """Write three maps as cube.npy, with plan.yaml and calibration.yaml."""
    geometry = Geometry.build(height=32, columns=90)
    point = WorkingPoint(procedural_scene(geometry.height, geometry.width), DENSE, geometry)
    maps = [np.load(point.write_cube(folder, exposures=5, seed=seed)) for seed in range(3)]
    np.save(folder / "cube.npy", np.concatenate(maps))


def all_tasks(folder: Path) -> Iterator[Task]:
    """Everything that is hashed."""
    ways = {"made": made_by, "scanned": scanned, "printed": printed}
    for name, case in read_cases().items():
        for step, line in (case["steps"] or {}).items():
            if line is not None:
                way, *words = words_of(line, folder, name, case)
                yield name, step, partial(ways[way], words)


def run(tasks: Sequence[Task]) -> Results:
    """Hashes of all tasks, each done in a folder of its own that is removed afterwards; a line of each is printed.

    Files that cannot be read are a difference like any other, and no reason to lose the other hashes.
    """

    def one(task: Task) -> Hashes:
        with tempfile.TemporaryDirectory(prefix="identity-") as scratch:
            try:
                return task[2](Path(scratch))
            except (OSError, ValueError, LookupError) as error:
                return {"exit code": f"files that cannot be read: {without_folders(repr(error))}"}

    results: Results = {}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for (name, step, _), hashes in zip(tasks, pool.map(one, tasks), strict=True):
            results.setdefault(name, {})[step] = hashes
            whole = digest(json.dumps(hashes, sort_keys=True).encode())
            print(f"{name:30} {step:16} {len(hashes):4}  {whole[:16]}  {hashes['exit code']}", flush=True)
    return results


def rig(words: Words, folder: Path) -> tuple[Hashes, str]:
    """Exit code of `rig`, with its error where it is above 1, and what it printed, without the folders in it."""
    command = [RIG, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=ENVIRONMENT, check=False)
    if done.returncode in (0, 1):
        return {"exit code": str(done.returncode)}, without_folders(done.stdout)
    said = without_folders(done.stderr).strip().splitlines() or ["nothing said"]
    return {"exit code": f"{done.returncode}: {said[-1]}"}, ""


def made_by(words: Words, scratch: Path) -> Hashes:
    """Hashes of the folder that a command writes; scratch: where there is room for it."""
    return rig((*words, "--out", scratch / "out"), scratch)[0] | folder_hashes(scratch / "out")


def printed(words: Words, scratch: Path) -> Hashes:
    """Hash of what a command prints."""
    ended, told = rig(words, scratch)
    return ended | {"printed": digest(told.encode())}


def scanned(words: Words, scratch: Path) -> Hashes:
    """Hashes as of `made_by`, with the frames up to the marker that closes the last sweep of each start.

    How many frames are recorded behind that marker depends on the moment at which the devices are stopped.
    """
    hashes, recorded, exported = made_by(words, scratch), scratch / "out", scratch / "hdf5" / "run.h5"
    rig(("export", recorded, "hdf5", "--out", exported.parent), scratch)
    if exported.exists():
        with h5py.File(exported) as file:
            of_frame = {name: np.squeeze(column[:]) for name, column in file["frames"].items()}
        bound = bound_frames(of_frame, json.loads((recorded / "manifest.json").read_text()))
        hashes |= {f"frames:{name}": array_hash(column) for name, column in bound.items()}
    return hashes


def bound_frames(of_frame: Mapping[str, np.ndarray], manifest: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The frames up to the end of the last sweep of their start of the SPAD, of arrays with one entry a frame.

    Ticks count from the first frame of the start: the frames behind the last marker put the next one off.
    """
    sweeps = manifest["sweeps"]
    last = np.cumsum([start["sweeps"] for start in manifest["recording"]["starts"]]) - 1
    ends = np.array([sweeps[min(index, len(sweeps) - 1)]["end_frame"] for index in last])
    _, first, start_of_frame = np.unique(of_frame["run"], return_index=True, return_inverse=True)
    kept = of_frame["number"] <= ends[start_of_frame]
    timed = {**of_frame, "ticks": of_frame["ticks"] - of_frame["ticks"][first][start_of_frame]}
    return {name: column[kept] for name, column in timed.items() if name != "time_s"}


def folder_hashes(folder: Path) -> Hashes:
    """Hashes of the results in a folder: arrays, clouds, pictures, the numbers of its calibrations, plans and summary.

    The manifest's sweeps alone count: it also holds the host and how much was recorded.
    """
    hashes: Hashes = {}
    for file in sorted(folder.rglob("*")):
        name = file.relative_to(folder).as_posix()
        if file.suffix == ".npy":
            hashes[name] = array_hash(np.load(file, allow_pickle=False))
        elif file.suffix == ".npz":
            with np.load(file, allow_pickle=False) as members:
                for member in sorted(members.files):
                    array = members[member]
                    if array.dtype.kind == "U" and array.ndim == 0 and str(array).startswith("{"):
                        hashes |= mapping_hashes(f"{name}:{member}", json.loads(str(array)))
                    else:
                        hashes[f"{name}:{member}"] = array_hash(array)
        elif file.suffix in (".ply", ".png"):
            hashes[name] = digest(file.read_bytes())
        elif name == "manifest.json":
            content = json.loads(file.read_text())
            hashes |= mapping_hashes(name, {"sweeps": content.get("sweeps")})
        elif name in ("summary.json", "frames.json"):
            hashes |= mapping_hashes(name, json.loads(file.read_text()))
        elif re.fullmatch(r"(calibration|camera|plan.*)\.yaml", name):
            hashes |= mapping_hashes(name, yaml.load(file.read_bytes(), yaml.CSafeLoader))
    return hashes


def array_hash(array: np.ndarray) -> str:
    """Hash of type, shape and bytes: of the arrays that a container holds, since those note when they were written."""
    return digest(f"{array.dtype.str}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())


def mapping_hashes(name: str, content: Mapping[str, Any]) -> Hashes:
    """Hashes of each key of a file's content, without moments and paths; numbers count to the last bit."""
    kept = {key: json.dumps(value, sort_keys=True, default=str) for key, value in without_moments(content).items()}
    return {f"{name}:{key}": digest(text.encode()) for key, text in kept.items()}


def without_moments(value: Any) -> Any:
    """The value without the keys of MOMENTS, at any depth, and without folders."""
    if isinstance(value, str):
        return without_folders(value)
    if isinstance(value, dict):
        return {str(key): without_moments(each) for key, each in value.items() if key not in MOMENTS}
    return [without_moments(each) for each in value] if isinstance(value, list) else value


def without_folders(text: str) -> str:
    """The text with the names of files in place of their paths, which differ from run to run."""
    return re.sub(r"/\S*/", "", text)


def digest(data: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def differences(before: Results, now: Results) -> list[str]:
    """A line for each hash that changed, is missing or is new: case, step, file and member."""
    was, has = (
        {(name, step, file): one for name, steps in each.items() for step in steps for file, one in steps[step].items()}
        for each in (before, now)
    )
    lines = []
    for key in sorted({key for key, _ in was.items() ^ has.items()}):
        how = "is missing" if key not in has else "is new" if key not in was else "differs"
        codes = f" ({was.get(key)} before, {has.get(key)} now)" if key[2] == "exit code" else ""
        lines.append(f"{', '.join(key)} {how}{codes}")
    return lines


if __name__ == "__main__":
    sys.exit(main())
