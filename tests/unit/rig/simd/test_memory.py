"""Arrays of which a kernel takes the address: none is freed before its address was used for the last time."""

import ast
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
import pytest

from rig.simd.memory import address_of, keep_alive

TREE = Path(__file__).parents[4]
KERNELS = [
    file for part in ("rig", "sim_backend", "calibration") for file in sorted((TREE / part).rglob("*.py"))
    if "address_of(" in file.read_text()
]  # fmt: skip


@numba.njit
def _taken_again(kept: bool) -> int:
    """How many of twenty arrays, allocated one after the other, come to lie where the first one was."""
    first = np.empty(1000, np.float32)
    at, again = address_of(first), 0
    for _ in range(20):
        again += address_of(np.empty(1000, np.float32)) == at
    if kept:
        keep_alive(first)
    return again


@numba.njit
def _forgotten() -> int:
    first = np.empty(1000, np.float32)
    at, again = address_of(first), 0
    for _ in range(20):
        again += address_of(np.empty(1000, np.float32)) == at
    return again


def test_memory_of_an_array_is_given_away_unless_it_is_kept_alive() -> None:
    assert _forgotten() > 0
    assert _taken_again(True) == 0


def _name(node: ast.expr) -> str:
    while isinstance(node, ast.Subscript | ast.Attribute):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


def _called(node: ast.AST, name: str) -> Iterator[ast.expr]:
    """All arguments in calls of `name` within a node."""
    for call in ast.walk(node):
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == name:
            yield from call.args


def _allocated(function: ast.FunctionDef) -> set[str]:
    """Local names that hold the result of a call, so maybe an array of their own."""
    names = set()
    for assigned in ast.walk(function):
        if not isinstance(assigned, ast.Assign):
            continue
        for target in assigned.targets:
            several = isinstance(target, ast.Tuple) and isinstance(assigned.value, ast.Tuple)
            pairs = zip(target.elts, assigned.value.elts, strict=True) if several else [(target, assigned.value)]
            names |= {_name(one) for one, value in pairs if isinstance(value, ast.Call)}
    return names


@pytest.mark.parametrize("file", KERNELS, ids=lambda file: str(file.relative_to(TREE)))
def test_arrays_that_a_kernel_allocates_are_kept_alive_until_their_addresses_were_used(file: Path) -> None:
    for function in ast.walk(ast.parse(file.read_text())):
        if isinstance(function, ast.FunctionDef):
            taken = {_name(argument) for argument in _called(function, "address_of")} & _allocated(function)
            kept = {_name(argument) for argument in _called(function, "keep_alive")}
            kept |= {_name(node.value) for node in ast.walk(function) if isinstance(node, ast.Return) and node.value}
            assert taken <= kept, f"{function.name} must keep alive {sorted(taken - kept)}"
