"""The versions that are allowed are those that docs/results/versions.md says were tried, and majors have an end."""

import re
import tomllib
from pathlib import Path

import pytest

from tests.campaigns.packages import OF_USERS, Trial, every_python, oldest_versions, running

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PAGE = (ROOT / "docs" / "results" / "versions.md").read_text()


def wanted() -> list[str]:
    extras = PROJECT["optional-dependencies"]
    return [*PROJECT["dependencies"], *(each for extra in OF_USERS for each in extras[extra])]


def test_every_dependency_of_users_has_a_lowest_version_which_the_campaign_tries_and_the_page_names() -> None:
    lowest = dict(line.split("==") for line in oldest_versions())
    assert len(lowest) == len(wanted())
    for name, version in lowest.items():
        assert f"`{name}` {version}" in PAGE


@pytest.mark.parametrize(("name", "next_major"), [("numpy", 3), ("opencv-contrib-python-headless", 6), ("pydantic", 3)])
def test_majors_that_may_break_are_left_out(name: str, next_major: int) -> None:
    (found,) = (each for each in wanted() if each.startswith(f"{name}>="))
    assert found.endswith(f",<{next_major}")


def test_the_pythons_that_the_package_claims_are_those_of_the_table() -> None:
    claimed = {found[1] for line in PROJECT["classifiers"] if (found := re.search(r"Python :: (3\.\d+)$", line))}
    tried = {".".join(found.split(".")[:2]) for found in re.findall(r"^\| (3\.\d+\.\d+) ", PAGE, re.MULTILINE)}
    assert claimed == tried


def test_this_python_is_found_and_a_trial_is_a_row_of_the_table(tmp_path: Path) -> None:
    assert running(str(tmp_path)) == ""
    assert any(version.startswith("3.") for version in every_python())
    row = Trial("3.12.1", "newest", {"numpy": "2.5.5"}, "complete, 9 s with compiling", "3 passed").row()
    assert row == "| 3.12.1 | newest | 2.5.5 |  |  |  |  | complete, 9 s with compiling | 3 passed |"
