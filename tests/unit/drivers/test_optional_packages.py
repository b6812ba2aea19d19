"""The command that installs a missing package names the version that is needed, where the program knows it."""

import sys
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

from drivers import optional_packages


def _needs(name: str) -> list[str]:
    return ["numpy>=1.26", "zstandard>=0.22; extra == 'compress'"]


def _is_called_otherwise(name: str) -> list[str]:
    raise PackageNotFoundError(name)


@pytest.mark.parametrize(("requires", "wanted"), [(_needs, "zstandard>=0.22"), (_is_called_otherwise, "zstandard")])
def test_the_package_is_installed_in_the_version_that_is_needed(
    requires: Callable[[str], list[str]], wanted: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(optional_packages, "requires", requires)
    assert optional_packages.install_command("zstandard") == f'"{sys.executable}" -m pip install "{wanted}"'


def test_what_a_package_adds_is_found_as_soon_as_it_is_on_the_import_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    group = "spadrig.laser"
    ours = {entry.name for entry in optional_packages.added(group)}
    about = tmp_path / "lamp-1.dist-info"
    about.mkdir()
    (about / "entry_points.txt").write_text(f"[{group}]\nlamp = lamp:KIND\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert {entry.name for entry in optional_packages.added(group)} == {*ours, "lamp"}
