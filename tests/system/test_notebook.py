"""The calls of docs/how-to/python.md, on a rig small enough for a test."""

import gc
from pathlib import Path

import pytest

from drivers.ring import BlockRing
from rig.api import effects, plan_scan, plan_text, scan
from tests.system.small_rig import HEIGHT, WIDTH

NOTEBOOK = Path(__file__).parents[2] / "docs" / "how-to" / "python.md"


def test_a_scan_is_one_call_and_writes_nothing_unasked(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    told: list[tuple[int, int]] = []
    result = scan(small, maps=2, seed=1, progress=lambda done, planned: told.append((done, planned)))
    assert result.last is not None
    assert result.truth is not None
    assert result.last.depth_m.shape == (HEIGHT, WIDTH)
    assert result.summary.maps == 2
    assert result.folder is None
    assert told[-1][0] >= 0.9 * told[-1][1]
    assert sorted(tmp_path.rglob("*")) == before


def test_plan_and_effects_are_one_call_each(small: Path) -> None:
    plan = plan_scan(small, exposures=3)
    assert plan.exposures == 3
    assert " x 3 frames at 100 kHz" in plan_text(plan)
    assert {effect.effect for effect in effects(small)} >= {"stripe", "fog"}


def test_the_document_runs_as_far_as_names_go() -> None:
    code = NOTEBOOK.read_text().split("```python\n")[1].split("```")[0]
    assert len([line for line in code.splitlines() if line.strip()]) <= 10
    compile(code, str(NOTEBOOK), "exec")


def test_a_scan_gives_back_the_memory_of_its_ring(small: Path) -> None:
    """Its threads and callbacks refer to one another, and many scans in one process ran out of memory."""
    before = {id(each) for each in gc.get_objects() if type(each) is BlockRing}  # other tests'
    gc.disable()
    try:
        scan(small, seed=1, estimator="joint", exposures=2)
        left = [each for each in gc.get_objects() if type(each) is BlockRing and id(each) not in before]
    finally:
        gc.enable()
    assert not left
