"""Figures of the tree, on a tree of a few files."""

from pathlib import Path

import pytest

from tests.reference import house

FILES = {
    "drivers/__init__.py": '''"""Devices."""

from drivers.laser import Laser

__all__ = ["Laser"]
''',
    "drivers/laser.py": '''"""What a laser is."""


class Laser:
    """A laser."""
''',
    "drivers/units.py": '''"""Units."""

PER_MW = 1e3
"""The same in milliwatts."""
PER_W = 1
"""The same is true of watts."""
''',
    "calibration/__init__.py": "",
    "rig/__init__.py": '''"""Application."""

VERSION = 1
''',
    "rig/laser.py": '''"""Use of the laser."""

from typing import TYPE_CHECKING

from drivers import units

if TYPE_CHECKING:
    from rig.scan import Scan


class Laser:
    def taken_power_w(self) -> None:
        """How much."""
''',
    "rig/scan.py": '''"""A scan."""

from rig import laser


class Scan:
    def __init__(self, a, b, c, d, e, f, g, h, i): ...


def start(a, b, c, d, e, *, f, g, h, i, **rest):
    def desk(): ...


@njit(nogil=True)
def add(a, b, c, d, e, f, g, h, i, j): ...


def _add(a, b, c, d, e, f, g, h, i, j): ...
''',
    "tests/test_scan.py": "import rig\n\n",
}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Root of the made-up tree."""
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def found(tree: Path) -> dict[str, house.Figure]:
    words = {"drivers", "calibration", "rig", "laser", "units", "scan", "power", "w", "start", "add"}
    return {figure.name: figure for figure in house.figures(tree, words)}


def test_modules_faces_lines_and_folders_are_counted(tree: Path) -> None:
    figures = found(tree)
    assert (figures["modules"].value, figures["modules"].told) == (7, "7, 2 package faces among them")
    assert figures["lines"].value == sum(len(text.splitlines()) for name, text in FILES.items() if "tests" not in name)
    assert figures["median"].value == 5
    assert (figures["folder"].value, figures["folder"].told) == (3, "3 modules in rig")
    assert figures["tests"].value == 2


def test_a_folder_with_a_limit_of_its_own_counts_only_beyond_it(tree: Path) -> None:
    effects = tree / "sim_backend" / "effects"
    effects.mkdir(parents=True)
    for number in range(20):
        (effects / f"effect{number}.py").touch()
    assert found(tree)["folder"].value == 3
    (effects / "more.py").touch()
    assert found(tree)["folder"].told == "21 modules in sim_backend/effects"


def test_imports_for_types_and_in_functions_make_circles_of_their_own_kind(tree: Path) -> None:
    circles = found(tree)["circles"]
    assert (circles.value, circles.items) == (0, ["deferred: rig.laser, rig.scan"])
    text = (tree / "rig" / "laser.py").read_text()
    (tree / "rig" / "laser.py").write_text(text.replace("if TYPE_CHECKING:", "if True:"))
    circles = found(tree)["circles"]
    assert (circles.value, circles.items) == (1, ["rig.laser, rig.scan"])


def test_modules_with_a_single_importer_are_named_with_it(tree: Path) -> None:
    assert found(tree)["single"].items == [
        "drivers.laser by drivers", "drivers.units by rig.laser", "rig.laser by rig.scan", "rig.scan by rig.laser",
    ]  # fmt: skip


def test_imports_that_name_nothing_are_found_wherever_they_stand(tree: Path) -> None:
    assert found(tree)["missing"].value == 0
    (tree / "tests" / "test_scan.py").write_text(
        "import rig.scam\nimport os\nfrom rig import laser, taser\nfrom rig.scan import Scan, add, desk\n"
        "def test():\n    from drivers.gone import Laser\n"
    )
    assert found(tree)["missing"].items == [
        "tests/test_scan.py:1: rig.scam", "tests/test_scan.py:3: rig taser", "tests/test_scan.py:4: rig.scan desk",
        "tests/test_scan.py:6: drivers.gone Laser",
    ]  # fmt: skip


def test_functions_of_many_parameters_are_told_apart(tree: Path) -> None:
    parameters = found(tree)["parameters"]
    assert parameters.items == [
        "rig.scan._add: 10, private", "rig.scan.add: 10, compiled", "rig.scan.start: 10, public",
    ]  # fmt: skip
    assert parameters.value == 1
    assert parameters.told == "3 functions with 10 or more parameters, 1 of them public and not compiled"


def test_docstrings_that_begin_with_a_clause_are_named(tree: Path) -> None:
    assert found(tree)["docstrings"].items == [
        "drivers/laser.py:1: What a laser is.",
        "drivers/units.py:4: The same in milliwatts.",
        "rig/laser.py:13: How much.",
    ]


def test_names_outside_the_word_list_and_names_of_two_things_are_named(tree: Path) -> None:
    figures = found(tree)
    assert figures["words"].items == ["taken: 1, rig.laser.Laser.taken_power_w"]
    assert figures["same-modules"].items == ["laser: drivers.laser, rig.laser"]
    assert figures["same-classes"].items == ["Laser: drivers.laser, rig.laser"]
    assert house.words_in("UsbIPBus_spad512s") == ["usb", "ip", "bus", "spad", "s"]


def test_limits_decide_the_exit_code_and_goals_are_only_told(
    tree: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert house.main(["--root", str(tree)]) == 0
    assert house.main(["--root", str(tree), "--limits"]) == 1
    assert [line for line in capsys.readouterr().out.splitlines() if "should be" in line] == [
        "broken: median is 5, it should be at least 130: short by 125",
        "broken: parameters is 1, it should be at most 0: short by 1",
        "broken: docstrings is 3, it should be at most 0: short by 3",
        "broken: same-classes is 1, it should be at most 0: short by 1",
    ]
    lines = int(found(tree)["lines"].value)
    monkeypatch.setattr(house, "LIMITS", {"lines": ("at most", 10), "tests": ("at most", 2)})
    assert house.main(["--root", str(tree), "--limits"]) == 0
    told = f"goal, no failure: lines is {lines}, it should be at most 10: short by {lines - 10}"
    assert capsys.readouterr().out.splitlines()[-1] == told
