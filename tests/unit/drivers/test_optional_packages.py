"""The command that installs a missing package fits how the program was installed."""

import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from drivers.optional_packages import install_command

METADATA = """\
Metadata-Version: 2.4
Name: spadrig
Version: 9.9
Requires-Dist: numpy>=1.26
Provides-Extra: compress
Requires-Dist: zstandard>=0.22; extra == 'compress'
"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Metadata of an installed spadrig, found before any other."""
    info = tmp_path / "site" / "spadrig-9.9.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(METADATA)
    monkeypatch.syspath_prepend(str(info.parent))
    return info


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    folder = tmp_path / "a checkout"
    folder.mkdir()
    (folder / "pyproject.toml").touch()
    return folder


def wanted(source: dict[str, Any] | None, site: Path) -> list[str]:
    """What pip is told to install where direct_url.json says `source`."""
    if source is not None:
        (site / "direct_url.json").write_text(json.dumps(source))
    words = shlex.split(install_command("zstandard", "compress"))
    assert words[:4] == [sys.executable, "-m", "pip", "install"]
    return words[4:]


def test_a_checkout_is_installed_with_the_extra_as_it_was(site: Path, checkout: Path) -> None:
    for dir_info, option in (({"editable": True}, ["-e"]), ({}, [])):
        source = {"url": checkout.as_uri(), "dir_info": dir_info}
        assert wanted(source, site) == [*option, f"{checkout}[compress]"]


@pytest.mark.parametrize(
    "source",
    [
        None,  # from an index
        {"url": "file:///tmp/spadrig-9.9-py3-none-any.whl", "archive_info": {}},
        {"url": "file:///gone/checkout", "dir_info": {"editable": True}},
        {"url": "https://example.org/spadrig.git", "vcs_info": {"vcs": "git", "commit_id": "0"}},
    ],
)
def test_elsewhere_the_package_is_installed_alone_in_the_version_that_is_needed(
    site: Path, source: dict[str, Any] | None
) -> None:
    assert wanted(source, site) == ["zstandard>=0.22"]


def test_a_program_without_metadata_names_the_package(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (site / "METADATA").unlink()
    site.rmdir()
    monkeypatch.setattr(sys, "path", [str(site.parent)])
    assert wanted(None, site) == ["zstandard"]


def test_a_shell_takes_the_command_apart_as_it_is_meant(site: Path, checkout: Path) -> None:
    wanted({"url": checkout.as_uri(), "dir_info": {"editable": True}}, site)
    command = install_command("zstandard", "compress").replace(sys.executable, "printf '%s|'", 1)
    ran = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=True, timeout=30)
    assert ran.stdout == f"-m|pip|install|-e|{checkout}[compress]|"
