"""Whether results are bit for bit those of an earlier program: hashes of everything that commands compute.

    python -m tests.reference.identity make --folder F
    python -m tests.reference.identity check --folder F --write before.json
    python -m tests.reference.identity check --folder F --against before.json

`make` records the scans of `identity_cases` and writes a bare cube and the views of a calibration; `check` reconstructs
them with every estimator, replays them, scans and calibrates anew, compiles plans, and hashes what comes out. Only
commands (`rig ...`) and files are used, so that modules may move. Hashes differ between machines. With --against the
exit code is 1 where anything differs.
"""

import argparse
import hashlib
import json
import os
import re
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

from tests.reference.identity_cases import BOARD, CASES, SEED, write_case, write_cube

Hashes = dict[str, str]
"""By file, or file:member."""
Results = dict[str, dict[str, Hashes]]
"""By case and step."""
Task = tuple[str, str, Callable[[Path], Hashes]]
"""Case, step and what hashes it, given an empty folder."""

RIG = Path(sys.executable).with_name("rig")
ENVIRONMENT = os.environ | {"OPENCV_FOR_THREADS_NUM": "1"}
"""OpenCV 5.0 adds up in the order in which its threads end: `cv2.calibrateCamera` differs in its last bits."""
ESTIMATES = {name: ("--estimator", name, "--filter", "none") for name in ("argmax", "edge", "likelihood", "joint")}
ESTIMATES["median"] = ("--estimator", "edge", "--filter", "median")
ONLY_JOINT = ("learning-K10",)
"""Recorded with the temporal prior, which the other estimators refuse."""
SCENES = tuple(f"street{kind}" for kind in ("", "-clear", "-light-fog", "-dense-fog", "-smoke", "-rain", "-snow"))
CONFIGS = ("simulated", "simulated-4-lines", "lab-emulated", "lab-spad512s-emulated", "lab", "hil")
PLANS = {"as it is": (), "K 1": ("--exposures", "1"), "K 20": ("--exposures", "20")}
POSES = 6
ACCURACY = ("--at", "3 m", "--accuracy", "20 mm")

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
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="commands that run at the same time")
    given = parser.parse_args(arguments)
    folder = given.folder.resolve()
    if given.verb == "make":
        make(folder, given.jobs)
        return 0
    tasks = [task for task in all_tasks(folder) if given.only in task[0]]
    results = run(tasks, given.jobs)
    print_table(results)
    if given.write is not None:
        given.write.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n")
    if given.against is None:
        return 0
    before = json.loads(given.against.read_text())
    found = differences({name: steps for name, steps in before.items() if given.only in name}, results)
    print("\n".join(found) if found else f"identical with {given.against}")
    return 1 if found else 0


def make(folder: Path, jobs: int) -> None:
    """Write rigs, recordings, the cube and the views of a calibration into a new folder."""
    folder.mkdir(parents=True)
    commands = []
    for name, case in CASES.items():
        config = write_case(case, folder / name / "rig")
        commands.append((scan_options(name, config), folder / name / "run"))
    write_cube(folder / "cube")
    board = write_case(BOARD, folder / "board" / "rig")
    commands.append((planes_options(board), folder / "board" / "planes"))
    with ThreadPoolExecutor(jobs) as pool:
        for code, told in pool.map(lambda each: rig(*each[0], "--out", each[1]), commands):
            if code not in (0, 1):
                raise SystemExit(told)


def scan_options(name: str, config: Path) -> tuple[object, ...]:
    """Words of the command that records a case."""
    case = CASES[name]
    return ("scan", config, "--record", "--maps", case.maps, "--seed", SEED)


def planes_options(board: Path) -> tuple[object, ...]:
    """Words of the command that calibrates the rig with a board."""
    board_file, scene = board.with_name("board.yaml"), board.with_name("scene.yaml")
    return (
        "calibrate", "planes", board, "--board", board_file, "--scene", scene,
        "--poses", POSES, "--exposures", "3,6", *ACCURACY, "--stated-baseline", "300 mm", "--seed", SEED,
    )  # fmt: skip


def all_tasks(folder: Path) -> Iterator[Task]:
    """Everything that is hashed."""
    for name, case in CASES.items():
        recorded = folder / name / "run"
        for step, options in ESTIMATES.items():
            if step == "joint" or name not in ONLY_JOINT:
                yield name, step, partial(made_by, ("reconstruct", recorded, *options))
        options = ESTIMATES["joint" if name in ONLY_JOINT else "likelihood"]
        yield name, "replay", partial(made_by, ("replay", recorded, "--clock", "max", *options))
        yield name, "frames", partial(exported, recorded)
        if case.repeats:
            yield name, "scan", partial(scanned, scan_options(name, folder / name / "rig" / "config.yaml"))
    cube = folder / "cube"
    plan = ("--plan", cube / "plan.yaml", "--calibration", cube / "calibration.yaml")
    for step, options in ESTIMATES.items():
        yield "cube-K5", step, partial(made_by, ("reconstruct", cube / "cube.npy", *plan, *options))
    first = folder / next(iter(CASES)) / "rig" / "config.yaml"
    for scene in SCENES:
        words = ("scan", first, "--scene", scene, "--exposures", 3, "--record", "--seed", SEED + 1)
        yield scene, "scan", partial(scanned, words)
        words = ("effects", first, "--scene", scene, "--row", 30, "--column", 90, "--json")
        yield scene, "flux", partial(printed, words)
    for name in CONFIGS:
        yield f"config {name}", "shown", partial(printed, ("config", "show", name))
        for step, choice in PLANS.items():
            yield f"config {name}", step, partial(printed, ("scan", name, "--dry-run", *choice, "--json"))
    yield from calibrations(folder)


def calibrations(folder: Path) -> Iterator[Task]:
    """Calibrations of live rigs and of views that are kept."""
    board, kept = folder / "board" / "rig" / "config.yaml", folder / "board" / "planes"
    print_of = ("--board", board.with_name("board.yaml"))
    scene = ("--scene", board.with_name("scene.yaml"))
    found = ("--calibration", kept / "calibration.yaml")
    steps: dict[str, tuple[object, ...]] = {
        "planes": planes_options(board)[1:],
        "planes of views": ("planes", kept, *print_of, *ACCURACY),
        "camera": ("camera", kept, *print_of),
        "sync": ("sync", board, *found, *scene, "--exposures", "2,6", "--seed", SEED, *ACCURACY),
        "check": ("check", board, *found, *print_of, *scene, "--seed", SEED + 1, *ACCURACY),
        "pixels": ("pixels", folder / "dirty-sensor-K20" / "rig" / "config.yaml", "--light", "--seed", SEED),
    }
    for step, words in steps.items():
        yield "calibrate", step, partial(made_by, ("calibrate", *words))


def run(tasks: Sequence[Task], jobs: int) -> Results:
    """Hashes of all tasks, each done in a folder of its own that is removed afterwards.

    Files that cannot be read are a difference like any other, and no reason to lose the other hashes.
    """

    def one(task: Task) -> Hashes:
        name, step, hashed = task
        with tempfile.TemporaryDirectory(prefix="identity-") as scratch:
            try:
                hashes = hashed(Path(scratch))
            except (OSError, ValueError, LookupError) as error:
                hashes = {"exit code": f"files that cannot be read: {without_folders(repr(error))}"}
        print(f"{name}: {step}", file=sys.stderr, flush=True)
        return hashes

    results: Results = {}
    with ThreadPoolExecutor(jobs) as pool:
        for (name, step, _), hashes in zip(tasks, pool.map(one, tasks), strict=True):
            results.setdefault(name, {})[step] = hashes
    return results


def rig(*words: object, cwd: Path | None = None) -> tuple[int, str]:
    """Exit code of `rig` and what it printed: stdout where it is 0 or 1, else stderr."""
    command = [RIG, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=ENVIRONMENT, check=False)
    return done.returncode, done.stdout if done.returncode in (0, 1) else done.stderr


def made_by(command: Sequence[object], scratch: Path) -> Hashes:
    """Hashes of the folder that a command writes; scratch: where there is room for it."""
    code, told = rig(*command, "--out", scratch / "out", cwd=scratch)
    return ended(code, told) | folder_hashes(scratch / "out")


def scanned(command: Sequence[object], scratch: Path) -> Hashes:
    """Hashes as of `made_by`, with the plan, and the frames up to the marker that closes the last sweep of each start.

    How many frames are recorded behind that marker depends on the moment at which the devices are stopped.
    """
    hashes = made_by(command, scratch)
    recorded = scratch / "out"
    if not (recorded / "manifest.json").exists():
        return hashes
    code, told = rig("export", recorded, "hdf5", "--out", scratch / "hdf5", cwd=scratch)
    hashes |= plan_hashes(recorded) | ended(code, told, "export's exit code")
    if code in (0, 1):
        manifest = json.loads((recorded / "manifest.json").read_text())
        with h5py.File(scratch / "hdf5" / "run.h5") as file:
            of_frame = {name: np.squeeze(column[:]) for name, column in file["frames"].items()}
        hashes |= {f"frames:{name}": array_hash(column) for name, column in bound_frames(of_frame, manifest).items()}
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


def exported(recorded: Path, scratch: Path) -> Hashes:
    """Hashes of a recording's plans and of all its frames."""
    code, told = rig("export", recorded, "npy", "--out", scratch / "npy", cwd=scratch)
    hashes = plan_hashes(recorded) | ended(code, told, "export's exit code") | folder_hashes(scratch / "npy")
    if code in (0, 1):
        hashes |= mapping_hashes("frames.json", json.loads((scratch / "npy" / "frames.json").read_text()))
    return hashes


def plan_hashes(recorded: Path) -> Hashes:
    """Hashes of the compiled plans in a run folder."""
    hashes: Hashes = {}
    for file in sorted(recorded.glob("plan*.yaml")):
        hashes |= mapping_hashes(file.name, yaml.load(file.read_bytes(), yaml.CSafeLoader))
    return hashes


def printed(command: Sequence[object], scratch: Path) -> Hashes:
    """Hash of what a command prints, without the folders that it names."""
    code, told = rig(*command, cwd=scratch)
    return ended(code, told) | {"printed": digest(without_folders(told).encode())}


def ended(code: int, told: str, name: str = "exit code") -> Hashes:
    """The exit code, as it is, with the error where there is one."""
    if code in (0, 1):
        return {name: str(code)}
    said = without_folders(told).strip().splitlines()
    return {name: f"{code}: {said[-1] if said else 'nothing said'}"}


def without_folders(text: str) -> str:
    """The text with the names of files in place of their paths, which differ from run to run."""
    return re.sub(r"/\S*/", "", text)


def folder_hashes(folder: Path) -> Hashes:
    """Hashes of the results in a folder: arrays, clouds, pictures, the numbers of its calibration and summary."""
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
        elif name in ("calibration.yaml", "camera.yaml"):
            hashes |= mapping_hashes(name, yaml.safe_load(file.read_bytes()))
        elif name in ("summary.json", "manifest.json"):
            content = json.loads(file.read_text())
            kept = ("sweeps",) if name == "manifest.json" else content
            hashes |= mapping_hashes(name, {key: content[key] for key in kept if key in content})
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


def digest(data: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def differences(before: Results, now: Results) -> list[str]:
    """A line for each hash that changed, is missing or is new: case, step, file and member."""
    lines = []
    for name, step in sorted({(case, each) for results in (before, now) for case in results for each in results[case]}):
        was, has = (results.get(name, {}).get(step, {}) for results in (before, now))
        for file in sorted(was.keys() | has.keys()):
            if was.get(file) == has.get(file):
                continue
            how = "is missing" if file not in has else "is new" if file not in was else "differs"
            codes = f" ({was.get(file)} before, {has.get(file)} now)" if file.endswith("exit code") else ""
            lines.append(f"{name}, {step}, {file} {how}{codes}")
    return lines


def print_table(results: Results) -> None:
    """Print a line for each case and step: how many hashes, what they come to, and how the command ended."""
    for name, steps in results.items():
        for step, hashes in steps.items():
            whole = digest(json.dumps(hashes, sort_keys=True).encode())
            code = next((value for file, value in hashes.items() if file.endswith("exit code") and value != "0"), "0")
            print(f"{name:30} {step:16} {len(hashes):4}  {whole[:16]}  {code}")


if __name__ == "__main__":
    sys.exit(main())
