"""A path that does not exist is answered with the one that was meant, if there is one of the right kind."""

import pytest

from rig.errors import absent


@pytest.fixture
def runs(tmp_path):
    for name in ("street-take", "wall", ".street-taken"):
        (tmp_path / name).mkdir()
    (tmp_path / "street-take.html").touch()
    return tmp_path


def test_a_path_of_a_similar_name_beside_it_is_named(runs):
    said = absent(runs / "street-tak", "name a run", lambda path: path.is_dir())
    assert said == f"{runs / 'street-tak'} does not exist; did you mean '{runs / 'street-take'}'? name a run"


@pytest.mark.parametrize("name", ["nothing-like-it", "nowhere/street-take", "street-take.html/wall"])
def test_otherwise_only_what_to_do(runs, name):
    assert absent(runs / name, "name a run") == f"{runs / name} does not exist; name a run"


def test_a_link_that_leads_nowhere_is_not_named(runs):
    (runs / "lost").symlink_to(runs / "nowhere")
    assert "did you mean" not in absent(runs / "lost", "name a run")


def test_paths_of_another_kind_are_not_named(runs):
    assert "did you mean" not in absent(runs / "street-take.htm", "name a run", lambda path: path.name == "wall")
