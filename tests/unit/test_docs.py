"""The documentation keeps what it promises: its links lead somewhere, its commands and modules exist."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from rig.cli import app

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / "README.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").rglob("*.md")])
pages = pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])


def test_every_figure_of_the_results_is_measured() -> None:
    results = (ROOT / "docs" / "results.md").read_text()
    assert "TO-MEASURE" not in results
    assert not re.findall(r"@@\w+@@", results)


def test_every_decision_is_listed_and_numbered_without_a_gap() -> None:
    files = sorted((ROOT / "docs" / "decisions").glob("*.md"))
    assert [int(file.name[:4]) for file in files] == list(range(1, len(files) + 1))
    listed = re.findall(r"^(\d+)\. \[(.*)\]\(decisions/(.*)\)$", (ROOT / "docs" / "README.md").read_text(), re.M)
    assert [(int(number), name) for number, _, name in listed] == [(int(f.name[:4]), f.name) for f in files]
    for (number, _, _), file in zip(listed, files, strict=True):
        assert file.read_text().startswith(f"# {number}. ")


@pages
def test_links_lead_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if link.startswith(("http://", "https://")):
            continue
        file, _, heading = link.partition("#")
        target = (page.parent / file).resolve() if file else page
        assert target.exists(), link
        assert not heading or heading in anchors(target), link


@pages
def test_modules_that_are_to_be_run_exist(page: Path) -> None:
    for module in re.findall(r"python -m (tests[.\w]+)", page.read_text()):
        assert (ROOT / (module.replace(".", "/") + ".py")).exists(), module


@pages
def test_commands_exist_with_the_options_they_are_given(page: Path) -> None:
    for words in commands(page.read_text()):
        command, said = typer.main.get_command(app), "rig"
        rest = words[1:]
        while hasattr(command, "commands") and rest and re.fullmatch(r"[a-z]+", rest[0]):
            said += f" {rest[0]}"
            assert rest[0] in command.commands, f"{said} ({' '.join(words)})"
            command, rest = command.commands[rest[0]], rest[1:]
        given = {word.split("=")[0] for word in rest if word.startswith("--")}
        assert given <= options(command), f"{said}: {given - options(command)} ({' '.join(words)})"


def anchors(page: Path) -> set[str]:
    """What the headings of a page are linked by."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in headings}


def commands(text: str) -> Iterator[list[str]]:
    """Words of every `rig ...` in code, in blocks and in lines, without comments."""
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.M | re.S)
    lines = [line.split(" # ")[0] for block in blocks for line in block.splitlines()]
    inline = re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))
    for line in (*lines, *inline):
        words = re.split(r"[\s\[\]|()]+", line.strip().removesuffix(","))
        if words[0] == "rig" and len(words) > 1:
            yield words


def options(command: Any) -> set[str]:
    """Names of its options, `--help` among them."""
    return {"--help", *(name for one in command.params for name in (*one.opts, *one.secondary_opts))}
