"""The documentation keeps what it promises: its links lead somewhere, its commands and modules exist."""

import ast
import re
import shlex
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import typer

from docs.generate import MARK, config_keys, fill, sections
from docs.generate.commands import commands
from rig.cli.main import app
from rig.config.bundled import bundled_rigs, bundled_scenes
from sim_backend.effects.catalogue import CATALOGUE

ROOT = Path(__file__).parents[2]
TOP = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")
BUILT = ROOT / "docs" / "_build"
NOTEBOOKS = sorted((ROOT / "docs" / "tutorials").glob("*.ipynb"))
PAGES = sorted(
    [*(ROOT / name for name in TOP), *(p for p in (ROOT / "docs").rglob("*.md") if BUILT not in p.parents), *NOTEBOOKS]
)
PACKAGES = ("rig", "drivers", "calibration", "sim_backend", "tests")
TREES = (*PACKAGES, "config", "docs")
pages = pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])


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


def test_every_page_is_listed_in_the_index_and_so_in_the_navigation_of_the_site() -> None:
    listed = {
        (ROOT / "docs" / page).resolve()
        for pages_of in sections((ROOT / "docs" / "README.md").read_text()).values()
        for page in pages_of
    }
    unlisted = [page for page in PAGES if page.with_suffix("") not in listed and page.stem != "README"]
    assert [str(page.relative_to(ROOT)) for page in unlisted] == []


def test_every_effect_has_a_row() -> None:
    rows = (ROOT / "docs" / "explanation" / "simulation.md").read_text()
    assert [entry.name for entry in CATALOGUE if f"`{entry.name}`" not in rows] == []


def test_every_key_of_a_config_has_a_meaning_in_the_reference() -> None:
    rows = [row for row in config_keys.page().splitlines() if row.startswith("| `")]
    assert len(rows) > 200
    assert [row for row in rows if row.split("|")[-2].strip() == ""] == []


def test_every_command_has_a_section_with_its_options() -> None:
    text = fill((ROOT / "docs" / "reference" / "commands.md").read_text())
    for name, command in commands(rig(), "rig"):
        section = re.search(rf"^#+ {name}\n(.*?)(?=^#|\Z)", text, re.M | re.S)
        if name != "rig":
            assert section is not None, name
            own = [] if hasattr(command, "commands") else [one for one in options(command) if one[:2] == "--"]
            assert [one for one in own if one != "--help" and one not in section[1]] == [], name


def test_generated_parts_are_those_that_generators_make() -> None:
    marks = [mark for page in PAGES for mark in MARK.findall(page.read_text())]
    assert sorted(marks) == ["commands", "config keys", "python api"]
    with pytest.raises(KeyError, match="nothing"):
        fill("<!-- generated: nothing -->")


def test_figures_are_shown_described_and_small() -> None:
    shown = set()
    for page in PAGES:
        for drawn, words, link in re.findall(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)", page.read_text()):
            assert not drawn or len(words) > 20, f"{page}: {link} is not described"
            shown.add((page.parent / link).resolve())
    for figure in (ROOT / "docs" / "figures").iterdir():
        assert figure in shown, f"no page shows {figure.name}"
        assert figure.suffix == ".svg"
        assert figure.stat().st_size < 100_000
        assert not re.search(r'(?:href|src)="(?!#|data:)', figure.read_text()), (
            f"{figure.name} refers to something outside"
        )


@pages
def test_modules_that_are_to_be_run_exist(page: Path) -> None:
    for module in re.findall(r"python -m (tests[.\w]+)", page.read_text()):
        path = ROOT / module.replace(".", "/")
        assert path.with_suffix(".py").exists() or (path / "__main__.py").exists(), module


@pages
def test_files_and_modules_that_are_named_exist(page: Path) -> None:
    if page.name == "CHANGELOG.md":  # tells of what was, too
        return
    for code in inline_code(page.read_text()):
        for name in missing_files(code) + missing_names(code):
            pytest.fail(f"`{code}`: there is no {name}")


@pytest.mark.parametrize(
    "code", ["rig/scan/scam.py", "rig/*_scan.py", "tests.reference.hoose", "rig.plan.compile.BLOCK_MS"]
)
def test_a_name_of_what_is_not_there_is_found(code: str) -> None:
    assert missing_files(code) + missing_names(code) == [code]


@pages
def test_facts_have_sources_and_name_code_that_exists(page: Path) -> None:
    assert bad_rows(page.read_text()) == []
    for code in inline_code(page.read_text()):
        if place := re.fullmatch(r"([\w/]+\.py):([A-Za-z_][\w.]*)", code):
            assert place[2] in defined(place[1]), f"there is no {code}"


def test_a_fact_without_a_source_and_a_symbol_that_is_not_there_are_found() -> None:
    wrong = [r"| c \| d | | - | - |", "| e | f | - |"]
    head = "| fact | source | driver | emulator |\n|---|---|---|---|\n| a | b | - | - |\n"
    assert bad_rows(head + "\n".join([*wrong, "", "| g |"])) == wrong
    assert {"PAGES", "Path", "defined", "defined.names"} & defined("tests/unit/test_docs.py") == {"PAGES", "defined"}


def bad_rows(text: str) -> list[str]:
    """Rows of tables of facts that have not four cells with text."""
    tables = re.findall(r"^\| fact \| source \| driver \| emulator \|\n\|[-|]+\n((?:\|.*\n?)*)", text, re.M)
    rows = [row for table in tables for row in table.splitlines()]
    return [row for row in rows if not re.fullmatch(r"\|( *[^ |\\]([^|\\]|\\.)*\|){4}", row)]


@cache
def defined(path: str) -> set[str]:
    """Names that a file defines at its top, and those of its classes, dotted. Empty if there is no such file."""
    todo = [("", node) for node in ast.parse((ROOT / path).read_text()).body] if (ROOT / path).exists() else []
    names = set()
    for before, node in todo:
        if isinstance(node, ast.ClassDef):
            todo += [(f"{before}{node.name}.", inner) for inner in node.body]
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            names.add(before + node.name)
        for target in getattr(node, "targets", [getattr(node, "target", ast.Pass())]):
            names |= {before + one.id for one in ast.walk(target) if isinstance(one, ast.Name)}
    return names


@pages
def test_command_lines_parse(page: Path) -> None:
    for line, is_whole in command_lines(page.read_text()):
        for words in alternatives(shlex.split(line.removesuffix(" ..."))):
            problem = refused(words, is_whole and not line.endswith(" ..."))
            assert problem is None, f"{line}: {problem}"


@pytest.mark.parametrize("package", PACKAGES)
def test_pages_and_sections_that_code_cites_exist(package: str) -> None:
    for file in (ROOT / package).rglob("*.py"):
        if file == Path(__file__):
            continue
        for name, section in re.findall(r"(?<!\w)(docs/[\w/-]+\.md)(?:, ([A-Z][^.;:)\n]*))?", file.read_text()):
            assert (ROOT / name).exists(), f"{file}: {name}"
            heads = re.findall(r"^#+ (.*)$", (ROOT / name).read_text(), re.M)
            assert not section or section in heads, f"{file}: {name} has no section {section!r}"


def test_command_lines_in_configs_and_messages_parse() -> None:
    for file in (*(ROOT / "config").rglob("*.yaml"), *(ROOT / "rig").rglob("*.py"), *(ROOT / "drivers").rglob("*.py")):
        text = file.read_text()
        named = re.findall(r"[`'](rig [^`'\n{]*)[`']", text) + re.findall(r"(?:^#   |then: )(rig [^;\n]*)$", text, re.M)
        for line in named:
            for words in alternatives(shlex.split(line)):
                assert refused(words, is_whole=False) is None, f"{file}: {line}: {refused(words, is_whole=False)}"


@cache
def rig() -> Any:
    """The command line itself."""
    return typer.main.get_command(app)


@cache
def known_options() -> set[str]:
    """Options of the command line and of programs beside the tests."""
    scripts = "".join(file.read_text() for file in (ROOT / "tests").rglob("*.py"))
    return options(rig()) | set(re.findall(r'add_argument\("(--[a-z-]+)"', scripts))


@pages
def test_options_exist(page: Path) -> None:
    known = known_options()
    for code in inline_code(page.read_text()):
        if code.startswith("--"):
            named = set(re.findall(r"--[a-z-]+", code))
            assert named <= known, f"`{code}`: {named - known}"


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("rig scann", "scann"),
        ("rig calibrate plane", "plane"),
        ("rig scan --monitor", "--monitor"),
        ("rig scan simulate", "simulate is no bundled rig"),
        ("rig scan --scene fog", "fog is no bundled scene"),
        ("rig reconstruct cube.npy", "--out"),
    ],
)
def test_a_line_that_the_command_line_refuses_is_found(line: str, problem: str) -> None:
    assert problem in (refused(shlex.split(line), is_whole=True) or "")


@cache
def anchors(page: Path) -> set[str]:
    """What the headings of a page are linked by."""
    headings = re.findall(r"^#+ (.*)$", fill(page.read_text()), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in headings}


def inline_code(text: str) -> list[str]:
    """Pieces of code within its sentences."""
    return re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))


def missing_files(code: str) -> list[str]:
    """Python files named in a piece of code, and files and folders named from the root, that do not exist."""
    named = re.findall(r"(?<![\w./*-])[\w./*-]+(?:\.\w+|/)(?![\w./*-])", code)
    hides = [f"{package}.py" for package in PACKAGES]  # a file of others that would hide ours
    ours = [name for name in named if name.endswith(".py") or name.startswith(tuple(f"{tree}/" for tree in TREES))]
    ours = [name for name in ours if name not in hides]
    return [name for name in ours if not (ROOT / name).exists()]


def missing_names(code: str) -> list[str]:
    """Dotted names of our packages in a piece of code, such as `rig.x` or `rig.x.Y`, that cannot be imported."""
    named = re.findall(rf"(?<![\w./*-])(?:{'|'.join(PACKAGES)})(?:\.\w+)+(?![\w./*-])", code)
    return [name for name in named if not name.endswith((".json", ".yaml", ".py")) and not is_importable(name)]


def is_importable(name: str) -> bool:
    """Whether a dotted name is a module, or something in one."""
    parts = name.split(".")
    for n in range(len(parts), 0, -1):
        path = ROOT.joinpath(*parts[:n])
        if path.is_dir() or path.with_suffix(".py").exists():
            found: Any = import_module(".".join(parts[:n])) if n < len(parts) else None
            for part in parts[n:]:
                found = getattr(found, part, None)
                if found is None:
                    return False
            return True
    return False


def command_lines(text: str) -> Iterator[tuple[str, bool]]:
    """Every `rig ...` in code, without comments, and whether it is to be typed as it is: those in blocks are."""
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.M | re.S)
    whole = [line for block in blocks for line in block.splitlines()] + re.findall(r"^    (rig .*)$", text, re.M)
    for line in whole:
        for part in re.split(r"&&|;|#", line):
            if found := re.match(r"\s*(?:then: )?(rig( .*)?)$", part):
                yield found[1].split(" > ")[0], True
    for code in inline_code(text):
        if code.startswith("rig "):
            yield code, False


def alternatives(words: list[str]) -> list[list[str]]:
    """Command lines for `a|b`, one each; what may be left out, in brackets, stays."""
    plain = [word.strip("[]") for word in words]
    some = next((i for i, word in enumerate(plain) if "|" in word), None)
    if some is None:
        return [plain]
    return [[*plain[:some], one, *plain[some + 1 :]] for one in plain[some].split("|")]


def refused(words: list[str], is_whole: bool) -> str | None:
    """Why the command line refuses `rig ...`, None where it does not; nothing is run.

    is_whole: nothing that it needs may be missing. Values in capitals stand for any.
    """
    command, name = rig(), "rig"
    rest = ["1" if re.fullmatch(r"[A-Z_]+", word) else word for word in words[1:]]
    while hasattr(command, "commands") and rest and not rest[0].startswith("-"):
        if rest[0] not in command.commands:
            return f"{name} has no command {rest[0]}"
        name, command, rest = f"{name} {rest[0]}", command.commands[rest[0]], rest[1:]
    if hasattr(command, "commands") and rest:  # its options, such as --install-completion, act while they are parsed
        unknown = [word for word in rest if word not in options(command)]
        return f"{name} has no {unknown[0]}" if unknown else None
    try:
        given = command.make_context(name, rest).params
    except typer.Exit:  # --help, --version
        return None
    except Exception as error:
        if not hasattr(error, "format_message"):
            raise
        lacks = type(error).__name__ in ("MissingParameter", "BadOptionUsage", "NoArgsIsHelpError")
        return None if lacks and not is_whole else str(error.format_message())
    for key, bundled in (("config", bundled_rigs), ("scene", bundled_scenes)):
        asked = given.get(key)
        is_name = isinstance(asked, str) and asked != "1" and not re.search(r"[./]", asked)
        if is_name and asked not in [one.name for one in bundled()]:
            return f"{asked} is no bundled {'rig' if key == 'config' else 'scene'}"
    return None


def options(command: Any) -> set[str]:
    """Names of the options of a command and of those below it, `--help` among them."""
    own = {name for one in command.params for name in (*one.opts, *one.secondary_opts)}
    below = (options(each) for each in getattr(command, "commands", {}).values())
    return {"--help"}.union(own, *below)
