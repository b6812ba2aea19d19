"""The names of `rig.api`: each is imported when it is first used, and type checkers see all of them."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from rig import api

HEAVY = ("numba", "cv2")
"""Packages that take a tenth of a second or more to import."""


def loaded_by(code: str) -> set[str]:
    """Heavy packages that a new Python has loaded after `code`."""
    script = f"import sys\n{code}\nprint(*[name for name in {HEAVY} if name in sys.modules])"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(run.stdout.splitlines()[-1].split())


def test_each_name_is_what_type_checkers_take_it_for() -> None:
    (block,) = [node for node in ast.parse(Path(api.__file__).read_text()).body if isinstance(node, ast.If)]
    typed = {
        name.asname or name.name: (node.module, name.name)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    }
    assert sorted(typed) == sorted(api.__all__)
    for name, (module, there) in typed.items():
        assert module is not None
        found = getattr(api, name)
        assert found is getattr(sys.modules[module], there)
    assert set(api.__all__) <= set(dir(api))


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    for name in ("scann", "scene_effects"):
        with pytest.raises(AttributeError, match=f"module 'rig.api' has no attribute '{name}'"):
            getattr(api, name)


@pytest.mark.parametrize("code", ["import rig.api", "from rig.api import runs", "from rig.api import record"])
def test_what_needs_no_kernels_loads_none(code: str) -> None:
    assert loaded_by(code) == set()
