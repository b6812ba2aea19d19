"""Figures of the tree, on a tree of a few files."""

from pathlib import Path

import pytest

from tests.reference import house

FILES = {
    "drivers/__init__.py": '"""Devices."""\n\nfrom drivers.laser import Laser\n\n__all__ = ["Laser"]\n',
    "drivers/laser.py": '"""What a laser is."""\n\n\nclass Laser:\n    """A laser."""\n',
    "drivers/units.py": 'PER_MW = 1e3\n"""The same in milliwatts."""\nPER_W = 1\n"""The same is true of watts."""\n',
    "calibration/__init__.py": "",
    "rig/__init__.py": "VERSION = 1\n",
    "rig/laser.py": """from typing import TYPE_CHECKING
from drivers import units
if TYPE_CHECKING:
    from rig.scan import Scan
class Laser:
    def taken_power_w(self):
        '''How much.'''
""",
    "rig/scan.py": "from rig import laser\nclass Scan: ...\ndef start():\n    def desk(): ...\n",
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
    return {figure.name: figure for figure in house.figures(tree)}


def test_modules_faces_lines_and_folders_are_counted(tree: Path) -> None:
    figures = found(tree)
    assert (figures["modules"].value, figures["modules"].told) == (7, "7, 2 package faces among them")
    assert figures["lines"].value == sum(len(text.splitlines()) for name, text in FILES.items() if "tests" not in name)
    assert (figures["median"].value, figures["tests"].value) == (4, 2)
    assert (figures["folder"].value, figures["folder"].told) == (3, "3 modules in rig")


def test_imports_for_types_and_in_functions_make_circles_of_their_own_kind(tree: Path) -> None:
    circles = found(tree)["circles"]
    assert (circles.value, circles.items) == (0, ["deferred: rig.laser, rig.scan"])
    text = (tree / "rig" / "laser.py").read_text()
    (tree / "rig" / "laser.py").write_text(text.replace("if TYPE_CHECKING:", "if True:"))
    circles = found(tree)["circles"]
    assert (circles.value, circles.items) == (1, ["rig.laser, rig.scan"])


def test_imports_that_name_nothing_are_found_wherever_they_stand(tree: Path) -> None:
    assert found(tree)["missing"].value == 0
    (tree / "tests" / "test_scan.py").write_text(
        "import rig.scam\nimport os\nfrom rig import laser, taser\nfrom rig.scan import Scan, start, desk\n"
        "def test():\n    from drivers.gone import Laser\n"
    )
    assert found(tree)["missing"].items == [
        "tests/test_scan.py:1: rig.scam", "tests/test_scan.py:3: rig taser", "tests/test_scan.py:4: rig.scan desk",
        "tests/test_scan.py:6: drivers.gone Laser",
    ]  # fmt: skip


def test_docstrings_that_begin_with_a_clause_are_named(tree: Path) -> None:
    assert found(tree)["docstrings"].items == [
        "drivers/laser.py:1: What a laser is.",
        "drivers/units.py:2: The same in milliwatts.",
        "rig/laser.py:7: How much.",
    ]


def test_limits_decide_the_exit_code_and_goals_are_only_told(
    tree: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert house.main(["--root", str(tree)]) == 0
    assert house.main(["--root", str(tree), "--limits"]) == 1
    assert [line for line in capsys.readouterr().out.splitlines() if "should be" in line] == [
        "broken: median is 4, it should be at least 130: short by 126"
    ]
    lines = int(found(tree)["lines"].value)
    monkeypatch.setattr(house, "LIMITS", {"lines": ("at most", 10), "tests": ("at most", 2)})
    assert house.main(["--root", str(tree), "--limits"]) == 0
    told = f"goal, no failure: lines is {lines}, it should be at most 10: short by {lines - 10}"
    assert capsys.readouterr().out.splitlines()[-1] == told
