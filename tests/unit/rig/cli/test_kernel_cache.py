"""Kernels are kept where the user can write, and nowhere that another user could."""

import os
import stat

import pytest

from rig.cli import main as kernel_cache

pytestmark = pytest.mark.skipif(not hasattr(os, "getuid"), reason="folders of users are a matter of POSIX")


@pytest.fixture
def _nothing_writable(monkeypatch, tmp_path):
    monkeypatch.delenv(kernel_cache.VARIABLE, raising=False)
    monkeypatch.setattr(kernel_cache, "_writable", lambda folder: False)
    monkeypatch.setattr(kernel_cache.tempfile, "tempdir", str(tmp_path))
    yield
    os.environ.pop(kernel_cache.VARIABLE, None)


@pytest.mark.usefixtures("_nothing_writable")
@pytest.mark.parametrize("open_to_all", [False, True])
def test_a_private_folder_serves_where_nothing_can_be_written_and_one_open_to_others_is_not_trusted(
    tmp_path, open_to_all
):
    usual = tmp_path / f"spadrig-kernels-{os.getuid()}"
    if open_to_all:
        usual.mkdir()
        usual.chmod(0o777)
    kernel_cache.ensure_kernel_cache()
    folder = os.environ[kernel_cache.VARIABLE]
    assert (folder == str(usual)) is not open_to_all
    assert stat.S_IMODE(os.stat(folder).st_mode) == 0o700


def test_the_users_own_setting_stays(monkeypatch):
    monkeypatch.setenv(kernel_cache.VARIABLE, "/chosen")
    monkeypatch.setattr(kernel_cache, "_writable", lambda folder: False)
    kernel_cache.ensure_kernel_cache()
    assert os.environ[kernel_cache.VARIABLE] == "/chosen"
