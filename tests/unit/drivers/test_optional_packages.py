"""The command that installs a missing package names the version that is needed, where the program knows it."""

import sys
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError

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
