"""A few trials of `tests.campaigns.ends`: what is whole when a command is ended, and what is said of it."""

import os
from pathlib import Path

import pytest

from tests.campaigns.ends.material import material
from tests.campaigns.ends.trial import trial


@pytest.fixture(scope="module")
def materials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("material")
    material(folder, ["cut"])
    return folder


@pytest.mark.skipif(os.name == "nt", reason="signals and terminals of POSIX")
@pytest.mark.parametrize(
    ("end", "seed"),
    [pytest.param("Ctrl-C twice", 2, marks=pytest.mark.long), ("closed terminal", 1), ("2>&1 | head -1", 1)],
)
def test_a_cut_that_is_ended_leaves_nothing_or_a_whole_part(materials: Path, end: str, seed: int) -> None:
    found = trial("cut", end, seed, str(materials))
    assert found["wrong"] == [], found
