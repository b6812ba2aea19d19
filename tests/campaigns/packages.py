"""Builds wheel and source distribution, and tries them outside the checkout, in environments of their own.

    python -m tests.campaigns.packages                          # this Python, newest dependencies
    python -m tests.campaigns.packages --every --oldest         # each Python found, and the oldest versions allowed

In each environment the wheel is installed with its extras, and in an empty folder the command lists, checks and scans.
Then the quick unit tests of the unpacked source distribution run (`--no-tests` leaves them out). The result is a table
in Markdown, as in docs/results/versions.md; the exit code is 1 where something failed. It needs the package index. An
environment takes some minutes, most of them for compiling and tests.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[2]
SHOWN = ("numpy", "numba", "opencv-contrib-python-headless", "pydantic", "typer")
"""Distributions whose versions the table shows."""
OF_USERS = ("cluster", "compress", "exchange", "nidaq", "testing", "view")
"""Extras whose lowest versions are tried too."""
_BOUND = re.compile(r"([A-Za-z0-9._-]+)(\[[a-z,]+\])?>=([0-9.]+)")
_VERSION = re.compile(r"3\.(1[1-9])")
MOST_S = 3600


@dataclass
class Trial:
    """What was tried in one environment."""

    python: str
    wanted: str
    versions: dict[str, str] = field(default_factory=dict)
    scan: str = "not reached"
    tests: str = "left out"
    problems: list[str] = field(default_factory=list)

    def row(self) -> str:
        """A row of the table."""
        shown = " | ".join(self.versions.get(name, "") for name in SHOWN)
        return f"| {self.python} | {self.wanted} | {shown} | {self.scan} | {self.tests} |"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--every", action="store_true", help="each Python from 3.11 on that is found")
    parser.add_argument("--oldest", action="store_true", help="also the oldest dependencies, on the oldest Python")
    parser.add_argument("--no-tests", action="store_true", help="without the unit tests")
    parser.add_argument("--workers", type=int, default=2, help="of the unit tests")
    given = parser.parse_args(arguments)
    pythons = every_python() if given.every else {running(sys.executable): sys.executable}
    chosen = [(python, False) for python in pythons.values()]
    if given.oldest:
        chosen.insert(0, (pythons[min(pythons, key=_order)], True))
    trials = []
    with tempfile.TemporaryDirectory(prefix="spadrig-packages-") as name:
        folder = Path(name)
        wheel, source = build(folder / "dist"), unpack(folder)
        for number, (python, oldest) in enumerate(chosen):
            trials.append(tried(Path(python), oldest, wheel, source, folder / str(number), given))
            print(trials[-1].row(), *trials[-1].problems, sep="\n", flush=True)
    print(f"\n| Python | dependencies | {' | '.join(SHOWN)} | `rig scan` | quick tests |\n|{'---|' * (len(SHOWN) + 4)}")
    print("\n".join(trial.row() for trial in trials))
    return 1 if any(trial.problems for trial in trials) else 0


def _order(version: str) -> tuple[int, ...]:
    return tuple(map(int, version.split(".")))


def running(python: str) -> str:
    """The version of an interpreter; empty if it does not run."""
    try:
        shown = subprocess.run([python, "-c", "import platform; print(platform.python_version())"], capture_output=True)
    except OSError:
        return ""
    return shown.stdout.decode().strip() if shown.returncode == 0 else ""


def every_python() -> dict[str, str]:
    """Interpreters from 3.11 on, one for each minor version, by their version."""
    found: dict[str, str] = {}
    for python in candidates():
        version = running(python)
        if _VERSION.match(version) and _order(version)[:2] not in map(lambda one: _order(one)[:2], found):
            found[version] = python
    return dict(sorted(found.items(), key=lambda item: _order(item[0])))


def candidates() -> Iterator[str]:
    """Programs that may be such an interpreter: this one, those on the path, those of pyenv."""
    yield sys.executable
    for minor in range(11, 20):
        if found := shutil.which(f"python3.{minor}"):
            yield found
    roots = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    yield from map(str, sorted(roots.glob("3.1[1-9]*/bin/python"), reverse=True))


def build(folder: Path) -> Path:
    """Build the wheel and the source distribution; returns the wheel."""
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-d", str(folder)], cwd=ROOT, check=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def unpack(folder: Path) -> Path:
    """Unpack the source distribution; returns its folder."""
    (archive,) = (folder / "dist").glob("*.tar.gz")
    with tarfile.open(archive) as opened:
        opened.extractall(folder / "source", filter="data")
    (source,) = (folder / "source").iterdir()
    return source


def oldest_versions() -> list[str]:
    """The lowest version of each dependency, as pip's constraints."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *(each for extra in OF_USERS for each in extras.get(extra, ()))]
    return [f"{found[1]}=={found[3]}" for each in wanted if (found := _BOUND.match(each))]


def tried(python: Path, oldest: bool, wheel: Path, source: Path, folder: Path, given: argparse.Namespace) -> Trial:
    """Make an environment in `folder`, install the wheel, use the command, run the tests."""
    trial = Trial(running(str(python)), "oldest" if oldest else "newest")
    work = folder / "work"
    work.mkdir(parents=True)
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    env = {**kept, "NUMBA_CACHE_DIR": str(folder / "kernels"), "OPENBLAS_NUM_THREADS": "1"}

    def run(*command: object, cwd: Path = work) -> subprocess.CompletedProcess[str]:
        ended = subprocess.run(
            list(map(str, command)), cwd=cwd, env=env, capture_output=True, text=True, timeout=MOST_S
        )
        if ended.returncode:
            said = "\n".join((ended.stdout + ended.stderr).splitlines()[-25:])
            trial.problems.append(f"{' '.join(map(str, command))}: exit code {ended.returncode}\n{said}")
        return ended

    run(python, "-m", "venv", folder / "venv")
    there = folder / "venv" / "bin"
    constraints = folder / "oldest.txt"
    constraints.write_text("\n".join(oldest_versions() if oldest else ()))
    extras = ",".join(("compress", "exchange", "nidaq", "view", "tests"))
    options = ("--quiet", "--disable-pip-version-check", "--prefer-binary", "--constraint", constraints)
    if run(there / "python", "-m", "pip", "install", *options, f"{wheel}[{extras}]").returncode:
        return trial
    listed = json.loads(run(there / "python", "-m", "pip", "list", "--format", "json").stdout)
    trial.versions = {each["name"].lower(): each["version"] for each in listed}
    run(there / "rig", "--help")
    run(there / "rig", "scenes")
    run(there / "rig", "config", "check", "lab")
    begun = time.monotonic()
    if run(there / "rig", "scan", "--record", "--out", "scanned").returncode == 0:
        trial.scan = f"complete, {time.monotonic() - begun:.0f} s with compiling"
    run(there / "rig", "replay", "scanned", "--clock", "max", "--out", "again")
    if (work / "scanned" / "depth").exists() and not _same(work):
        trial.problems.append("the replay's depth is not that of the scan")
    if not given.no_tests:
        tests = shutil.copytree(source, folder / "source")
        options = ("-q", "-p", "no:cacheprovider", "-n", given.workers, "--dist", "loadfile", "-m", "not slow")
        ended = run(there / "python", "-m", "pytest", *options, "tests/unit", cwd=tests)
        trial.tests = ended.stdout.splitlines()[-1].strip("= ") if ended.stdout else "none ran"
    return trial


def _same(work: Path) -> bool:
    first, second = ((work / name / "depth" / "000000.npy").read_bytes() for name in ("scanned", "again"))
    return first == second


if __name__ == "__main__":
    sys.exit(main())
