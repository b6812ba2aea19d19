"""Which public numeric functions there are, and which tests hold each to its whole domain.

A test says with `@covers(depth)` whose domain it goes through. A file of unit tests says below its imports
`covers(depth, RowModel, kernels)` of a function, the methods of a class or all that a module has, where it compares
them with an independent reference. `test_inventory.py` fails where a function of `SCOPE` is covered by neither.
"""

import ast
import os
import re
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import TypeVar

from hypothesis import settings

ROOT = Path(__file__).parents[2]
SCOPE = (
    "calibration/*.py",
    *(f"drivers/{name}.py" for name in ("clock", "frames", "units", "replay/pace", "scanners/galvo")),
    *(f"rig/{folder}/*.py" for folder in ("count", "depth", "estimate", "geometry", "plan", "strategies")),
    *(f"rig/{name}.py" for name in ("recording/cube", "tradeoff/limits", "tradeoff/row_light", "tradeoff/rows")),
    *(f"sim_backend/{folder}/*.py" for folder in ("effects", "frames", "light", "projector")),
    *(f"sim_backend/{name}.py" for name in ("mirror_motion", "random_numbers", "scenes/medium", "scenes/scene")),
)
"""Files whose functions compute; the others move bytes, words and files, which tests/unit and tests/wire hold."""
NUMERIC = {"int", "float", "complex", "NDArray", "ArrayLike", "Array", "Fraction", "Pixels", "Counts"}
NUMERIC |= {"Float32", "Float64", "Int16", "Int32", "Uint8", "Bools"}
"""Names in an annotation by which a function takes or gives numbers."""

EXAMPLES = settings(
    max_examples=int(os.environ.get("STABILITY_EXAMPLES", "25")),
    derandomize="STABILITY_EXAMPLES" not in os.environ,
    deadline=None,
    database=None,
)
"""Few and always the same, unless the environment asks for more: STABILITY_EXAMPLES=3000 pytest tests/stability."""

Test = TypeVar("Test", bound=Callable[..., object])


def covers(*things: object) -> Callable[[Test], Test]:
    """Says which functions, methods, classes or modules a test takes through their domain; changes nothing."""

    def unchanged(test: Test) -> Test:
        return test

    return unchanged


@cache
def public_functions() -> list[str]:
    """Every public function and method within SCOPE that takes or gives numbers, as "module:Class.name"."""
    found = []
    for path in sorted(ROOT.glob("[cdrs]*/**/*.py")):
        file = path.relative_to(ROOT).as_posix()
        if any(fnmatch(file, pattern) for pattern in SCOPE):
            module = file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
            body = ast.parse(path.read_text(encoding="utf-8")).body
            found += [f"{module}:{name}" for name in _numeric(body)]
    return found


@cache
def covered() -> set[str]:
    """What the tests say they cover, as "module:Class.name"; read from their source, so that none has to be run."""
    found = set()
    for path in [*ROOT.glob("tests/stability/test_*.py"), *ROOT.glob("tests/unit/**/test_*.py")]:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        imported = {
            alias.asname or alias.name: (node.module, alias.name)
            for node in tree.body
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "covers":
                for thing in node.args:
                    first, *rest = ast.unparse(thing).split(".")
                    module, name = imported[first]
                    found.add(f"{module}:{'.'.join([name, *rest])}")
    return found


def covering(name: str) -> set[str]:
    """What covers a function "module:Class.name": itself, its class or its module, as `covered` writes them."""
    module, _, inner = name.partition(":")
    package, _, last = module.rpartition(".")
    return {name, f"{module}:{inner.partition('.')[0]}", f"{package}:{last}"}


def _numeric(body: list[ast.stmt], of: str = "") -> Iterator[str]:
    for node in body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            if "Protocol" not in {ast.unparse(base) for base in node.bases}:
                yield from _numeric(node.body, f"{of}{node.name}.")
        elif isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            notes = [note for note in (*(a.annotation for a in arguments), node.returns) if note is not None]
            # Compiled pieces that take whatever they are given carry no annotations.
            if any(NUMERIC & set(re.findall(r"\w+", ast.unparse(note))) for note in notes) or (arguments and not notes):
                yield of + node.name
