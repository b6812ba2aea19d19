"""What pages tell the reader to type is typed: commands in the order of each page, its Python, its notebooks.

The bundled simulated rig is replaced by a small one, so that a scan takes a second. The working directory has the files
that pages take for granted (`my-rig.yaml`, `cube.npy`, ...); all others must come from earlier commands of the page.
"""

import json
import re
import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from drivers.registry import SLOTS, kinds, lookup
from rig import api
from rig.config.bundled import BUNDLED
from tests.system.conftest import Rig
from tests.system.small_rig import HEIGHT, WIDTH, calibration, config
from tests.unit.test_docs import NOTEBOOKS, PAGES, ROOT

NOT_RUN: Mapping[str, str] = {
    r"rig calibrate (?!pixels)": "needs pictures of a board, and minutes: tests/system/calibrate",
    r"rig (import|reconstruct runs/)": "needs files of other cameras: tests/system/cli/test_cli_exchange.py",
    r"rig batch\b": "takes minutes: tests/system/cli/test_cli_batch.py",
    r"rig (scan|reconstruct) .*--out (recording|in-one|by-parts|monday-maps)\b": "takes minutes: tests/system/test_"
    "reconstruct_parts.py",
    r"rig tradeoff|rig scan runs/": "takes minutes: tests/system/cli/test_cli_tradeoff.py",
    r"rig (scan lab|replay taken)": "devices are missing or take real time: tests/system/test_lab_emulated.py",
    r"rig .* /data/": "names folders of other computers",
    r"rig (bench|warmup)": "measures this machine, for a minute: tests/system/cli/test_cli_commands.py",
    r"rig effects$": "scans with and without each effect: tests/system/cli/test_cli_commands.py",
    r"rig record\b": "acts on a scan that goes on: tests/system/scans/test_record_on_request.py",
    r"rig (stream|view|align|demo)\b|rig .* --view\b": "goes on until it is stopped: tests of its own",
    r"rig record|rig scan .*--record-on-request": "needs a scan that goes on: tests/system/scans",
    r"rig devices": "depends on what is attached: tests/system/test_doctor.py",
    r"rig .*(\.\.\.|\b[A-Z][A-Z-]*\b)": "leaves a value open",
}
"""Commands that are not run, by a pattern of their beginning, and why. All are parsed (tests/unit/test_docs.py)."""
NOTEBOOK_COLUMNS = 250
"""Columns of the small rig of notebooks, one of which draws column 200."""
PYTHON = {"own-sensor.md"}
"""Pages whose Python is run here, block after block; other tests run that of one-device.md and python.md."""
COMMAND = re.compile(r"(?:then: )?(rig(?: .*?)?)(?: > (\S+))?")
Block = tuple[str, str]

markdown = [page for page in PAGES if page.suffix == ".md"]
pages = pytest.mark.parametrize("page", markdown, ids=[str(page.relative_to(ROOT)) for page in markdown])


def blocks(page: Path) -> list[Block]:
    """The blocks of code of a page: language and text."""
    found: list[Block] = []
    language, lines = None, []
    for line in page.read_text(encoding="utf-8").splitlines():
        fence = re.fullmatch(r" *```(\w*)", line)
        if fence and language is None:
            language, lines = fence[1], []
        elif fence:
            found.append((language or "", "\n".join(lines)))
            language = None
        elif language is not None:
            lines.append(line)
    return found


def commands_of(page: Path) -> list[tuple[str, str | None]]:
    """The commands in the blocks of a page, each with the file to which it is redirected."""
    parts = [
        part.strip()
        for language, text in blocks(page)
        if language == ""
        for line in text.splitlines()
        for part in re.split(r"&&|;|#", line)
    ]
    return [(found[1], found[2]) for part in parts if (found := COMMAND.fullmatch(part))]


def reason(command: str) -> str | None:
    """Why a command is not run; None if it is."""
    return next((why for pattern, why in NOT_RUN.items() if re.match(pattern, command)), None)


def write(path: Path, content: object) -> None:
    """Write a YAML file."""
    path.write_text(yaml.safe_dump(content), encoding="utf-8")


def small_rig(columns: int = 100) -> dict[str, Any]:
    """The config of a small rig under the name of the bundled one."""
    small = config() | {"name": "simulated", "calibration": "tiny.yaml", "estimate": {"estimator": "auto"}}
    small["world"] |= {"geometry": "./tiny.yaml", "scene": "street"}
    small["scan"] |= {"columns": columns}
    return small


@pytest.fixture
def bundled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of bundled configs, of which the simulated rig is a small one."""
    folder = Path(shutil.copytree(BUNDLED, tmp_path / "config"))
    write(folder / "tiny.yaml", calibration())
    write(folder / "simulated.yaml", small_rig())
    monkeypatch.setattr("rig.config.files.BUNDLED", folder)
    return folder


@pytest.fixture
def typed(rig: Rig, bundled: Path) -> Callable[[str, str | None], int]:
    """Type a command in a folder with what pages take for granted, and with a small rig as the bundled one."""
    small = small_rig()
    here = Path.cwd()
    write(here / "tiny.yaml", calibration())
    tangents = np.linspace(-0.3, 0.5, 20)
    np.save(here / "planes.npy", np.column_stack([np.ones(20), np.zeros(20), -tangents, np.full(20, -0.3)]))
    bare = {key: value for key, value in calibration().items() if key in ("format", "version", "camera")}
    write(here / "calibration.yaml", bare | {"planes": "planes.npy"})
    for name in ("my-rig.yaml", "lab.yaml"):
        write(here / name, small)
    write(here / "plan.yaml", {"columns": 20, "exposures": 2, "frame_rate": "100 kHz", "depth_range": ["1 m", "8 m"]})
    stripe_px = 110 * (np.repeat(tangents, 2) - 0.3 / 3) + (WIDTH - 1) / 2  # of a wall at 3 m
    away_px = np.abs(np.arange(WIDTH) - stripe_px[:, None, None])
    frames = np.random.default_rng(1).random((40, HEIGHT, WIDTH)) < np.where(away_px < 1, 0.9, 0.02)
    np.save(here / "cube.npy", np.packbits(frames, axis=2))

    def run(command: str, into: str | None) -> int:
        ran = rig(*shlex.split(command)[1:])
        assert ran.problems == [], command
        if into is not None and "lab" not in command:  # that of a real rig, whose devices are not here
            Path(into).write_text(ran.out, encoding="utf-8")
        return ran.code

    return run


def run_on(page: Path) -> list[tuple[str, str | None]]:
    """The commands of a page that are run, each once."""
    return [each for each in dict.fromkeys(commands_of(page)) if reason(each[0]) is None]


@pytest.mark.parametrize("page", [*filter(run_on, markdown)], ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_of_a_page_do_what_it_says(page: Path, typed: Callable[[str, str | None], int]) -> None:
    for command, into in run_on(page):
        assert typed(command, into) == 0, command


def test_most_commands_of_pages_are_run_and_every_reason_not_to_is_needed() -> None:
    named = {command for page in markdown for command, _ in commands_of(page)}
    assert sum(reason(command) is None for command in named) > 30
    assert [pattern for pattern in NOT_RUN if not any(re.match(pattern, command) for command in named)] == []


@pytest.mark.parametrize("name", sorted(PYTHON))
def test_python_of_a_page_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    page = next(page for page in markdown if page.name == name)
    place: dict[str, object] = {}
    for language, text in blocks(page):
        if language == "python":
            exec(compile(text, str(page), "exec"), place)


@pages
def test_python_and_yaml_of_a_page_are_what_the_program_takes(page: Path) -> None:
    for language, text in blocks(page):
        if language == "python":
            compile(text, str(page), "exec")
        content = yaml.safe_load(text) if language == "yaml" else None
        for slot in set(SLOTS) & set(content or ()):
            section = content[slot]
            if "kind" in section:
                assert section["kind"] in kinds(slot) or page.name == "plugin.md", section
                if section["kind"] in kinds(slot):
                    lookup(slot, section["kind"]).config.model_validate(section)


@pytest.mark.slow
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=[notebook.stem for notebook in NOTEBOOKS])
def test_a_notebook_runs_and_lies_there_without_outputs(notebook: Path, bundled: Path) -> None:
    """With a small rig in place of the simulated one, which `make docs` runs them with."""
    write(bundled / "simulated.yaml", small_rig(NOTEBOOK_COLUMNS))
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    place: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            assert (cell["outputs"], cell["execution_count"]) == ([], None)
            exec(compile("".join(cell["source"]), str(notebook), "exec"), place)


IN_WORDS = "versions", "config", "plan", "request", "rig", "devices", "calibration"
"""Parts of a manifest of which the page says what is in them, but not each key."""


def keys_in(content: Mapping[str, Any], before: str = "") -> Iterator[str]:
    """Dotted names of all keys, those of the first element of lists included."""
    for key, value in content.items():
        yield before + key
        part = value[0] if isinstance(value, list) and value else value
        if isinstance(part, dict):
            yield from keys_in(part, f"{before}{key}.")


@pytest.mark.parametrize("file", ["summary.json", "manifest.json"])
def test_the_page_of_run_folders_names_every_key(file: str, scanned: Path, tmp_path: Path) -> None:
    page = (ROOT / "docs" / "reference" / "run-folder.md").read_text()
    example = re.findall(r'"(\w+)":', page)
    words = re.findall(r"`([^`]+)`", re.sub(r"```.*?```", "", page, flags=re.DOTALL))
    named = {*example, *re.findall(r"\w+", " ".join(words))}
    api.reconstruct(scanned, out=tmp_path / "maps")
    for folder in (scanned, tmp_path / "maps"):
        keys = list(keys_in(json.loads((folder / file).read_text())))
        assert len(keys) > 40
        for key in keys:
            top, _, rest = key.partition(".")
            assert key.rpartition(".")[2] in named or (rest and top in IN_WORDS), f"{key} is not in run-folder.md"
