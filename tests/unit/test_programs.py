"""The programs beside the tests can be imported, and each command says what it does and takes."""

import sys
from importlib import import_module
from pathlib import Path
from runpy import run_module

import pytest

ROOT = Path(__file__).parents[2]
FILES = [
    file
    for folder in ("benchmarks", "campaigns", "reference")
    for file in sorted((ROOT / "tests" / folder).rglob("*.py"))
]
WITHIN_A_GUEST = "tests.campaigns.kernel.guest"
"""Process 1 of a virtual machine: nobody asks it for help."""


def name_of(file: Path) -> str:
    """The module's dotted name."""
    return ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


COMMANDS = [name for file in FILES if "__main__" in file.read_text() and (name := name_of(file)) != WITHIN_A_GUEST]


@pytest.mark.parametrize("name", [name_of(file) for file in FILES])
def test_it_can_be_imported(name: str) -> None:
    try:
        import_module(name)
    except ModuleNotFoundError as error:
        absent = (error.name or "").split(".")[0]
        if (ROOT / absent).is_dir():
            raise
        pytest.skip(f"needs {absent}")


@pytest.mark.parametrize("name", COMMANDS)
def test_it_says_what_it_takes(name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(SystemExit) as ended:
        run_module(name, run_name="__main__")
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith("usage: ")
