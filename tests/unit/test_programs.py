"""Each command beside the tests can be imported and says what it does and takes."""

import sys
from pathlib import Path
from runpy import run_module

import pytest

ROOT = Path(__file__).parents[2]
COMMANDS = [
    ".".join(file.relative_to(ROOT).with_suffix("").parts)
    for folder in ("benchmarks", "campaigns", "reference")
    for file in sorted((ROOT / "tests" / folder).rglob("*.py"))
    if "__main__" in file.read_text()
]


@pytest.mark.parametrize("name", COMMANDS)
def test_it_says_what_it_takes(name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(SystemExit) as ended:
        run_module(name, run_name="__main__")
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith("usage: ")
