"""Figures of the tree itself: modules, lines, folders, imports, parameters, docstrings, names.

    python -m tests.reference.house
    python -m tests.reference.house --details circles words
    python -m tests.reference.house --limits        # part of `make test`

Product code is `drivers`, `calibration`, `sim_backend`, `rig` and `spadrig`; sources are read, never imported. A
package face, an `__init__.py` of docstring and imports only, counts as a module, but not as one of its folder's. With
--limits each limit that is not kept is told; the exit code is 1 where one is broken that must hold. The goals, those of
lines, are told as 'short by N' and do not fail.
"""

from __future__ import annotations

import argparse
import ast
import re
import statistics
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

LIMITS: Mapping[str, tuple[str, int]] = {
    "modules": ("at most", 500),
    "lines": ("at most", 60_000),
    "median": ("at least", 130),
    "folder": ("at most", 12),
    "circles": ("at most", 0),
    "parameters": ("at most", 0),
    "docstrings": ("at most", 0),
    "missing": ("at most", 0),
    "same-classes": ("at most", 0),
    "tests": ("at most", 38_000),
}
GOALS = ("lines", "tests")
"""Limits that the tree is on its way to: told, but no failure."""
ROOMIER_FOLDERS = {"sim_backend/effects": 20}
"""Folders with a limit of their own: one file is one effect."""

PRODUCT = ("drivers", "calibration", "sim_backend", "rig", "spadrig")
MANY_PARAMETERS = 10
CLAUSES = ("What", "Of", "As", "Where", "How", "Whose", "Which", "Why", "When")
FINITE_VERBS = re.compile(r"\b(is|are|was|were|has|have|does|do|can|may|must|will|gives?|holds?|returns?|comes?)\b")
COMPILED = re.compile(r"\b(njit|jit|vectorize|guvectorize|intrinsic|overload|kernel)\b")
WORDS_FILE = Path(__file__).with_name("field_words.txt")

Function = ast.FunctionDef | ast.AsyncFunctionDef
Definition = Function | ast.ClassDef
Graph = dict[str, set[str]]
LOCALS = "<locals>"
"""Of a function: what is defined there is nobody else's business."""


@dataclass(frozen=True, slots=True)
class Module:
    """A source file: its path from the root, dotted name, number of lines, and what is in it."""

    path: Path
    name: str
    lines: int
    tree: ast.Module

    @property
    def is_package(self) -> bool:
        """Whether it is the `__init__.py` of a package."""
        return self.path.name == "__init__.py"

    @property
    def is_face(self) -> bool:
        """Whether it is a package's docstring and imports, nothing else."""
        return self.is_package and all(
            isinstance(node, ast.Import | ast.ImportFrom | ast.Expr) or _names_all(node) for node in self.tree.body
        )


@dataclass(frozen=True, slots=True)
class Figure:
    """One number of the tree, with the things that it counts."""

    name: str
    value: float
    told: str
    items: Sequence[str] = ()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=Path(__file__).parents[2], help="of the tree")
    parser.add_argument("--limits", action="store_true", help="compare with the limits; exit code 1 when broken")
    parser.add_argument("--details", nargs="*", default=(), metavar="FIGURE", help="list what these figures count")
    given = parser.parse_args(arguments)
    found = {figure.name: figure for figure in figures(given.root, words_of(WORDS_FILE))}
    if unknown := [name for name in given.details if name not in found]:
        parser.error(f"no figure is named {', '.join(unknown)}; choose from {', '.join(found)}")
    for figure in found.values():
        print(f"{figure.name:12} {figure.told}")
        if figure.name in given.details:
            print("".join(f"    {item}\n" for item in figure.items), end="")
    broken = broken_limits(found) if given.limits else {}
    for name, line in broken.items():
        print(f"goal, no failure: {line}" if name in GOALS else f"broken: {line}")
    return 1 if broken.keys() - set(GOALS) else 0


def figures(root: Path, field_words: set[str]) -> Iterator[Figure]:
    """All figures of the tree below root."""
    modules = read_modules(root, PRODUCT)
    faces = sum(module.is_face for module in modules)
    yield Figure("modules", len(modules), f"{len(modules)}, {faces} package faces among them")
    lines = sum(module.lines for module in modules)
    yield Figure("lines", lines, str(lines))
    median = statistics.median(module.lines for module in modules)
    own = statistics.median(module.lines for module in modules if not module.is_face)
    yield Figure("median", median, f"{median:g} lines a module, {own:g} without package faces")
    yield folder_figure(modules)
    loads, all_imports = import_graphs(modules)
    lone = lone_importers(all_imports)
    yield Figure("single", len(lone), f"{len(lone)} modules with a single importer", lone)
    circles = [", ".join(circle) for circle in circles_of(loads)]
    deferred = [circle for each in circles_of(all_imports) if (circle := ", ".join(each)) not in circles]
    told = f"{len(circles)} import circles; {len(deferred)} more or larger ones with imports in functions and for types"
    yield Figure("circles", len(circles), told, [*circles, *(f"deferred: {circle}" for circle in deferred)])
    yield parameter_figure(modules)
    clauses = sorted(f"{place}: {text}" for module in modules for place, text in clause_docstrings(module))
    yield Figure("docstrings", len(clauses), f"{len(clauses)} docstrings begin with a relative clause", clauses)
    yield word_figure(modules, field_words)
    of_tests = read_modules(root, ("tests",))
    tests = sum(module.lines for module in of_tests)
    yield Figure("tests", tests, f"{tests} lines of tests")
    missing = missing_imports([*modules, *of_tests])
    yield Figure("missing", len(missing), f"{len(missing)} imports of ours, tests' among them, name nothing", missing)
    stems = shared_names((module.path.stem, module.name) for module in modules if not module.path.stem.startswith("__"))
    yield Figure("same-modules", len(stems), f"{len(stems)} module names are used for two or more things", stems)
    classes = shared_names(
        (node.name, module.name)
        for module in modules
        for node in module.tree.body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    yield Figure("same-classes", len(classes), f"{len(classes)} class names are used for two or more things", classes)


def broken_limits(found: Mapping[str, Figure]) -> dict[str, str]:
    """A line for each limit that is not kept, by the figure's name."""
    lines = {}
    for name, (side, limit) in LIMITS.items():
        value = found[name].value
        if value > limit if side == "at most" else value < limit:
            lines[name] = f"{name} is {value:.10g}, it should be {side} {limit}: short by {abs(value - limit):.10g}"
    return lines


def read_modules(root: Path, packages: Iterable[str]) -> list[Module]:
    """All sources of these packages, by name."""
    modules = []
    for package in packages:
        for file in sorted((root / package).rglob("*.py")):
            path = file.relative_to(root)
            parts = path.with_suffix("").parts
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            text = file.read_text()
            modules.append(Module(path, name, len(text.splitlines()), ast.parse(text, str(path))))
    return modules


def folder_figure(modules: Sequence[Module]) -> Figure:
    """Modules of the fullest folder; one with a limit of its own only where it passes that."""
    counts = Counter(module.path.parent.as_posix() for module in modules if not module.is_face)
    judged = {folder: n for folder, n in counts.items() if n > ROOMIER_FOLDERS.get(folder, 0)}
    folder = max(judged, key=lambda each: judged[each], default="none")
    items = [f"{each}: {n}" for each, n in counts.most_common()]
    return Figure("folder", judged.get(folder, 0), f"{judged.get(folder, 0)} modules in {folder}", items)


def import_graphs(modules: Sequence[Module]) -> tuple[Graph, Graph]:
    """Who imports whom: as modules are loaded, and with imports in functions and for type checkers too."""
    names = {module.name for module in modules}
    loads: Graph = {name: set() for name in names}
    all_imports: Graph = {name: set() for name in names}
    for module in modules:
        for node, deferred in _imports(module.tree):
            named = _imported(node)
            targets = {f"{base}.{name}" if f"{base}.{name}" in names else base for base, name in named}
            targets = targets & names - {module.name}
            all_imports[module.name] |= targets
            if not deferred:
                loads[module.name] |= targets
    return loads, all_imports


def _imports(tree: ast.AST, deferred: bool = False) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    """Import statements, and whether loading the module leaves them out."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node, deferred
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield from _imports(ast.Module(node.body, []), True)
            yield from _imports(ast.Module(node.orelse, []), deferred)
        else:
            yield from _imports(node, deferred or isinstance(node, Function | ast.Lambda))


def _imported(node: ast.Import | ast.ImportFrom) -> list[tuple[str, str]]:
    """Modules that a statement names, each with the name that it takes from it, '' where it takes the module."""
    if isinstance(node, ast.Import):
        return [(alias.name, "") for alias in node.names]
    return [(node.module or "", alias.name) for alias in node.names]


def missing_imports(modules: Sequence[Module]) -> list[str]:
    """Imports of our packages, those in functions among them, of a module or a name in one that there is not."""
    names = {module.name: {*bound_names(module.tree)} for module in modules}
    packages = {name.rsplit(".", depth)[0] for name in names for depth in range(name.count(".") + 1)}
    ours = {package for package in packages if "." not in package}
    lines = []
    for module in modules:
        for node, _ in _imports(module.tree):
            for base, name in _imported(node):
                known = base in packages and (not name or name in names.get(base, ()) or f"{base}.{name}" in packages)
                if base.split(".")[0] in ours and not known:
                    lines.append(f"{module.path.as_posix()}:{node.lineno}: {base} {name}".rstrip())
    return lines


def bound_names(tree: ast.AST) -> Iterator[str]:
    """Names that a module has when it is loaded."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, Definition):
            yield node.name
        elif isinstance(node, ast.alias):
            yield node.asname or node.name
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        else:
            yield from bound_names(node)


def lone_importers(imports: Graph) -> list[str]:
    """Modules that one module alone imports, each with it."""
    importers = grouped((target, name) for name, targets in imports.items() for target in targets)
    return sorted(f"{name} by {by[0]}" for name, by in importers.items() if len(by) == 1)


def circles_of(graph: Graph) -> list[list[str]]:
    """Groups of two or more modules that reach each other, by name."""

    reach = {name: {*graph[name]} for name in graph}
    for between in graph:
        for seen in reach.values():
            if between in seen:
                seen |= reach[between]
    groups = {tuple(sorted(other for other in reach[name] if name in reach[other])) for name in graph}
    return sorted([*group] for group in groups if len(group) > 1)


def parameter_figure(modules: Sequence[Module]) -> Figure:
    """Functions with ten parameters or more. The value is the number of those that are public and not compiled."""
    items, public = [], 0
    for module in modules:
        for path, node in definitions(module.tree):
            if isinstance(node, ast.ClassDef) or (n := parameters(node)) < MANY_PARAMETERS:
                continue
            compiled = any(COMPILED.search(ast.unparse(each)) for each in node.decorator_list)
            outside = not compiled and is_public(path)
            public += outside
            kind = "compiled" if compiled else "public" if outside else "private"
            items.append(f"{module.name}.{'.'.join(path)}: {n}, {kind}")
    told = f"{len(items)} functions with {MANY_PARAMETERS} or more parameters, {public} of them public and not compiled"
    return Figure("parameters", public, told, sorted(items))


def parameters(node: Function) -> int:
    """Number of a function's parameters, without self and cls."""
    given = node.args
    named = [each.arg for each in (*given.posonlyargs, *given.args)]
    rest = sum(each is not None for each in (given.vararg, given.kwarg))
    return len(named) - (named[:1] in (["self"], ["cls"])) + len(given.kwonlyargs) + rest


def definitions(tree: ast.AST, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Definition]]:
    """Functions and classes at any depth, with their names from the outside in, `<locals>` behind a function's."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, Definition):
            yield (*path, node.name), node
            within = (node.name, LOCALS) if isinstance(node, Function) else (node.name,)
            yield from definitions(node, (*path, *within))
        else:
            yield from definitions(node, path)


def is_public(path: Sequence[str]) -> bool:
    """Whether no part of a dotted name is private; `__init__` is as public as its class."""
    return not any(part.startswith("_") and not part.endswith("__") for part in path)


def clause_docstrings(module: Module) -> Iterator[tuple[str, str]]:
    """Place and first line of docstrings that begin with a relative clause, those below attributes included."""
    for node in ast.walk(module.tree):
        for index, each in enumerate(getattr(node, "body", ()) if not isinstance(node, ast.Lambda | ast.IfExp) else ()):
            if not (isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant)):
                continue
            text = each.value.value
            first = index == 0 and isinstance(node, ast.Module | Definition)
            of_name = index > 0 and isinstance(node.body[index - 1], ast.Assign | ast.AnnAssign)  # type: ignore[attr-defined]
            if isinstance(text, str) and (first or of_name) and is_clause(text):
                yield f"{module.path.as_posix()}:{each.lineno}", text.strip().splitlines()[0]


def is_clause(docstring: str) -> bool:
    """Whether it begins with a relative clause, or with 'The same ...' without a verb."""
    text = docstring.strip()
    if text.split(maxsplit=1)[:1] and text.split(maxsplit=1)[0] in CLAUSES:
        return True
    sentence = re.split(r"[.;:](?:\s|$)", text, maxsplit=1)[0]
    return sentence.startswith("The same") and not FINITE_VERBS.search(sentence)


def word_figure(modules: Sequence[Module], field_words: set[str]) -> Figure:
    """Words of public names that are not in the word list, with how often and where first."""
    counts: Counter[str] = Counter()
    first: dict[str, str] = {}
    for where, name in public_names(modules):
        for word in words_in(name):
            if word not in field_words:
                counts[word] += 1
                first.setdefault(word, where)
    items = [f"{word}: {n}, {first[word]}" for word, n in sorted(counts.items(), key=lambda each: (-each[1], each[0]))]
    told = f"{len(counts)} words in public names, {counts.total()} times, are not in {WORDS_FILE.name}"
    return Figure("words", len(counts), told, items)


def public_names(modules: Sequence[Module]) -> Iterator[tuple[str, str]]:
    """Public names of packages, modules, classes, functions and methods, each with its dotted place."""
    for module in modules:
        own = module.name.rsplit(".", 1)[-1]
        if not own.startswith("_"):
            yield module.name, own
        for path, node in definitions(module.tree):
            if is_public(path) and not node.name.startswith("__") and LOCALS not in path:
                yield f"{module.name}.{'.'.join(path)}", node.name


def words_in(name: str) -> list[str]:
    """Words of a name in small letters, split at underscores, capitals and digits."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]


def words_of(file: Path) -> set[str]:
    """Words of a word list; lines that begin with # are none."""
    return {word for line in file.read_text().splitlines() if not line.startswith("#") for word in line.split()}


def shared_names(named: Iterable[tuple[str, str]]) -> list[str]:
    """Names that stand for two or more things, with where."""
    return sorted(f"{name}: {', '.join(where)}" for name, where in grouped(named).items() if len(where) > 1)


def grouped(pairs: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """The second of each pair by the first."""
    groups: dict[str, list[str]] = defaultdict(list)
    for key, value in pairs:
        groups[key].append(value)
    return groups


def _names_all(node: ast.stmt) -> bool:
    return isinstance(node, ast.Assign) and [ast.unparse(each) for each in node.targets] == ["__all__"]


if __name__ == "__main__":
    sys.exit(main())
