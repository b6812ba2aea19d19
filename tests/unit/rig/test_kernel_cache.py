"""Kernels are kept where the user can write, nowhere that another user could, and only as long as they hold."""

import errno
import os
import shutil
import stat
import subprocess
import sys
from functools import partial

import pytest

from rig import kernel_cache

posix = pytest.mark.skipif(not hasattr(os, "getuid"), reason="folders of users are a matter of POSIX")


@pytest.fixture
def _nothing_writable(monkeypatch, tmp_path):
    monkeypatch.delenv(kernel_cache.VARIABLE, raising=False)
    monkeypatch.setattr(kernel_cache, "_serves", lambda folder: False)
    monkeypatch.setattr(kernel_cache.tempfile, "tempdir", str(tmp_path))
    yield
    os.environ.pop(kernel_cache.VARIABLE, None)


@posix
@pytest.mark.usefixtures("_nothing_writable")
@pytest.mark.parametrize("taken_by", ["nothing", "a folder open to all", "a file", "a link to nothing"])
def test_a_private_folder_serves_where_nothing_can_be_written_and_one_of_others_is_not_trusted(tmp_path, taken_by):
    usual = tmp_path / f"spadrig-kernels-{os.getuid()}"
    if taken_by == "a folder open to all":
        usual.mkdir()
        usual.chmod(0o777)
    elif taken_by == "a file":
        usual.touch()
    elif taken_by == "a link to nothing":
        usual.symlink_to(tmp_path / "nowhere")
    kernel_cache.prepare_kernels()
    folder = os.environ[kernel_cache.VARIABLE]
    assert (folder == str(usual)) is (taken_by == "nothing")
    assert stat.S_IMODE(os.stat(folder).st_mode) == 0o700


@posix
def test_a_program_on_a_network_disk_keeps_its_kernels_on_a_disk_of_this_computer(monkeypatch, tmp_path):
    mounts = tmp_path / "mounts"
    mounts.write_text(
        f"disk / ext4 rw 0 0\nserver:/lab {tmp_path}/lab nfs4 rw 0 0\nserver:/la {tmp_path}/la ext4 rw 0 0\n"
    )
    (tmp_path / "lab" / "rig").mkdir(parents=True)
    assert kernel_cache.file_system_of(tmp_path / "lab" / "rig", mounts) == "nfs4"
    assert kernel_cache.file_system_of(tmp_path / "laboratory", mounts) == "ext4"
    assert kernel_cache.file_system_of(tmp_path, tmp_path / "none") == ""
    monkeypatch.setattr(kernel_cache, "file_system_of", lambda folder: "nfs4" if "lab" in folder.parts else "ext4")
    monkeypatch.setattr(kernel_cache, "TOP", tmp_path / "lab")
    monkeypatch.setenv(kernel_cache.VARIABLE, "")  # so that it is put back
    monkeypatch.delenv(kernel_cache.VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    kernel_cache.prepare_kernels()
    assert os.environ[kernel_cache.VARIABLE] == str(tmp_path / "home" / "spadrig-kernels")


def test_the_users_own_setting_stays(monkeypatch, tmp_path):
    monkeypatch.setenv(kernel_cache.VARIABLE, str(tmp_path))
    monkeypatch.setattr(kernel_cache, "_serves", lambda folder: False)
    kernel_cache.prepare_kernels()
    assert os.environ[kernel_cache.VARIABLE] == str(tmp_path)


def test_a_folder_that_cannot_be_asked_for_counts_as_not_there(monkeypatch, tmp_path):
    """As one below a folder that may not be searched; a name that is too long is refused to root, too."""
    monkeypatch.setattr(kernel_cache, "file_system_of", lambda folder: "ext4")
    assert kernel_cache._serves(tmp_path / ("x" * 300) / "cache")


@pytest.fixture
def tree(tmp_path):
    """Packages in which `rig.a` imports `rig.deep.b`, which imports `rig.deep.c`; `rig.d` imports nothing."""
    for file, text in {
        "rig/__init__.py": "", "rig/deep/__init__.py": "", "rig/a.py": "def late():\n    from rig.deep import b",
        "rig/deep/b.py": "from rig.deep.c import (\n    one,\n)", "rig/deep/c.py": "one = 1", "rig/d.py": "",
    }.items():  # fmt: skip
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text(text)
    return tmp_path


def kernels_of(folder):
    return {file.name.split(".")[0] for file in folder.rglob("*.nbi")}


@pytest.mark.parametrize("own_folder", [False, True])
def test_kernels_go_if_their_module_or_one_that_it_imports_has_changed(tree, tmp_path, own_folder):
    kept = tmp_path / "kept" if own_folder else None

    def compile_all():
        for module in ("a", "deep/b", "deep/c", "d"):
            file = tree / f"rig/{module}.py"
            folder = file.parent / "__pycache__" if kept is None else kept / f"{file.parent.name}_0123"
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"{file.stem}.kernel-1.py311.nbi").touch()

    def left():
        kernel_cache.forget_stale(tree, kept)
        return kernels_of(tree)

    compile_all()
    assert left() == set()  # nothing is known of them
    compile_all()
    assert left() == {"a", "b", "c", "d"}
    (tree / "rig/deep/c.py").write_text("one = 2 ")
    assert left() == {"d"}
    compile_all()
    (tree / "rig/d.py").write_text("one = 2")
    assert left() == {"a", "b", "c"}


def test_a_note_that_cannot_be_written_stops_nothing_and_leaves_nothing(tree, monkeypatch):
    def full(path, text):
        path.touch()
        raise OSError(errno.ENOSPC, "no space left on device")

    monkeypatch.setattr(kernel_cache.Path, "write_text", full)
    kernel_cache.forget_stale(tree, tree / "kept")
    assert not list((tree / "kept").iterdir())


def test_an_inlined_function_of_another_file_is_never_the_old_one(tree):
    """numba alone keeps the kernel here: this is why there is a note."""
    (tree / "rig/deep/c.py").write_text("import numba\n@numba.njit(inline='always')\ndef one():\n    return 1\n")
    (tree / "rig/a.py").write_text(
        "import numba\nfrom rig.deep.c import one\n@numba.njit(cache=True)\ndef both():\n    return one() + one()\n"
    )
    run = "import rig.a; print(rig.a.both())"

    def both():
        kernel_cache.forget_stale(tree, None)
        environment = {name: value for name, value in os.environ.items() if name != kernel_cache.VARIABLE}
        done = subprocess.run([sys.executable, "-c", run], cwd=tree, env=environment, capture_output=True, check=True)
        return int(done.stdout)

    assert both() == 2
    (tree / "rig/deep/c.py").write_text("import numba\n@numba.njit(inline='always')\ndef one():\n    return 21\n")
    assert both() == 42


_PROGRAM = """
import sys
from functools import partial
import rig  # which forgives
import numba

@numba.njit(cache=True)
def f(x):
    return x + 1

print(f(1), f(1.5) if "both" in sys.argv else "", sum(f.stats.cache_hits.values()))
"""


def ran(program, folder, *arguments):
    """What a program prints that keeps its kernels in a folder."""
    environment = {**os.environ, kernel_cache.VARIABLE: str(folder), "PYTHONPATH": str(kernel_cache.TOP)}
    done = subprocess.run(
        [sys.executable, program, *arguments], env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """A program with a function, and the folder of its kernels for two types."""
    place = tmp_path_factory.mktemp("compiled")
    program, folder = place / "program.py", place / "kernels"
    program.write_text(_PROGRAM)
    folder.mkdir()
    assert ran(program, folder, "both") == ["2", "2.5", "0"]
    assert ran(program, folder, "both") == ["2", "2.5", "2"]
    return program, folder


@pytest.fixture
def kept(compiled, tmp_path):
    """A copy of these kernels, and a call that runs the program with them and gives what it prints."""
    program, folder = compiled
    copy = shutil.copytree(folder, tmp_path / "kernels")
    return copy, partial(ran, program, copy)


@pytest.mark.slow
@pytest.mark.parametrize(("ending", "torn"), [pytest.param("nbi", 0, marks=pytest.mark.long), ("1.nbc", 100)])
def test_a_torn_file_of_kernels_costs_time_and_no_command(kept, ending, torn):
    folder, run = kept
    (file,) = folder.rglob(f"*.{ending}")
    os.truncate(file, torn)
    assert run("both") == ["2", "2.5", "0" if ending == "nbi" else "1"]
    assert run("both") == ["2", "2.5", "2"]


@pytest.mark.slow
def test_kernels_that_two_processes_have_mixed_up_are_not_called(kept):
    folder, run = kept
    one, other = (next(folder.rglob(f"*.{number}.nbc")) for number in (1, 2))
    one.write_bytes(other.read_bytes())
    assert run("both")[:2] == ["2", "2.5"]
    assert run("both") == ["2", "2.5", "2"]


@pytest.mark.long
@pytest.mark.slow
@posix
def test_a_full_disk_keeps_no_kernels_and_stops_none(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(f"import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (64, 64))\n{_PROGRAM}")
    (tmp_path / "full").mkdir()
    assert ran(program, tmp_path / "full", "both") == ["2", "2.5", "0"]
