"""A case has one name on all computers, and another one if anything changes on which its result depends."""

from pathlib import Path

import pytest

from drivers.recorded.contents import INDEX_FILE
from rig.batch import case as module
from rig.batch.case import INSTALLED, Case, call, changed_file, checksum, code_digest, files_of, package_of
from rig.errors import UsageError
from rig.kernel_cache import TOP
from tests.unit.rig.batch.executors import TINY

SQUARE = Case(f"{TINY}:square", {"x": 3, "sleep_s": 0.0}, {"x": 3})


def test_a_name_does_not_depend_on_the_order_of_inputs_or_on_labels() -> None:
    same = Case(f"{TINY}:square", {"sleep_s": 0.0, "x": 3}, {"another": "label"})
    assert SQUARE.name("code", {}) == same.name("code", {})


def test_a_name_changes_with_function_input_code_and_contents_of_files() -> None:
    with_file = Case(SQUARE.function, SQUARE.inputs, files=("/f",))
    names = {
        SQUARE.name("code", {}),
        SQUARE.name("other code", {}),
        Case(f"{TINY}:trouble", SQUARE.inputs).name("code", {}),
        Case(SQUARE.function, {"x": 4, "sleep_s": 0.0}).name("code", {}),
        with_file.name("code", {"/f": "a"}),
        with_file.name("code", {"/f": "b"}),
    }
    assert len(names) == 6
    assert {len(name) for name in names} == {module.NAME_DIGITS}


def test_a_case_is_called_by_name_and_must_return_a_mapping() -> None:
    assert SQUARE.call()["y"] == 9
    with pytest.raises(TypeError, match=r"builtins:list returned list; the result of a case is a mapping"):
        call("builtins:list", {})


def test_the_checksum_of_a_folder_sees_contents_and_names(tmp_path: Path) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "b" / "one").write_text("1")
    seen = [checksum(str(tmp_path / "a"))]
    (tmp_path / "a" / "b" / "one").write_text("2")
    seen.append(checksum(str(tmp_path / "a")))
    (tmp_path / "a" / "b" / "one").rename(tmp_path / "a" / "b" / "two")
    seen.append(checksum(str(tmp_path / "a")))
    assert len(set(seen)) == 3
    (tmp_path / "a").rename(tmp_path / "c")
    assert checksum(str(tmp_path / "c")) == seen[-1], "the place of the folder does not matter"


@pytest.mark.parametrize(
    ("name", "before", "after", "counts"),
    [
        ("frames-000000.spb", "0000", "1111", True),
        ("frames-000000.spb", "0000", "000", True),
        ("frames-000000.spb", "0" * 300_000, "0" * 299_999 + "1", True),
        ("frames-000000.spb", "0" * 300_000, "0" * 100_000 + "1" + "0" * 199_999, False),
        ("calibration.yaml", "focal: 600", "focal: 900", True),
        ("learned/000000.npz", "0000", "1111", True),
        ("depth/000000.npy", "0000", "11", False),
    ],
)
def test_of_a_recording_counts_what_a_replay_reads_and_frames_by_size_and_ends(
    tmp_path: Path, name: str, before: str, after: str, counts: bool
) -> None:
    (tmp_path / INDEX_FILE).write_text("where all blocks are")
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(before)
    one = checksum(str(tmp_path))
    (tmp_path / name).write_text(after)
    assert (checksum(str(tmp_path)) != one) == counts


def test_a_changed_file_is_found_and_unchanged_ones_are_not_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "folder").mkdir()
    one, other, folder = tmp_path / "one", tmp_path / "folder" / "other", tmp_path / "folder"
    one.write_text("1")
    other.write_text("2")
    files = {str(path): checksum(str(path)) for path in (one, folder)}
    assert changed_file(files) is None
    with monkeypatch.context() as patched:
        patched.setattr(module, "checksum", lambda path: pytest.fail(f"{path} was read again"))
        assert changed_file(files) is None
    other.write_text("22")
    assert changed_file(files) == str(folder)
    other.write_text("2")
    assert changed_file(files) is None
    one.unlink()
    assert changed_file(files) == str(one)


def test_whether_a_recording_has_changed_is_seen_without_a_look_at_all_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    index = tmp_path / INDEX_FILE
    index.write_text("checksums of all blocks")
    (tmp_path / "frames.bin").write_text("0000")
    files = {str(tmp_path): checksum(str(tmp_path))}
    with monkeypatch.context() as patched:
        patched.setattr(Path, "rglob", lambda *given: pytest.fail("all files were listed"))
        patched.setattr(module, "checksum", lambda path: files[path])
        assert changed_file(files) is None
    index.write_text("checksums of other blocks")
    assert changed_file(files) == str(tmp_path)
    assert changed_file({str(tmp_path / "gone"): "1"}) == str(tmp_path / "gone")


def test_a_folder_with_the_name_of_a_scene_is_not_that_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "street").mkdir()
    own = str(tmp_path / "street")
    assert files_of({"world": {"scene": "street"}}) == files_of({}, "street") == ()
    assert files_of({"world": {"scene": own}}) == files_of({}, own) == (own,)


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"cannot read .*none: No such file or directory; correct the path"):
        checksum(str(tmp_path / "none"))


def test_the_digest_of_the_code_sees_our_sources_and_those_of_the_cases(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "TOP", tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for package in ("rig", "lab_of_mine"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").write_text("")
    (tmp_path / "single.py").write_text("")
    seen = {}

    def look() -> dict[str, str]:
        code_digest.cache_clear()
        return {name: code_digest(name) for name in ("rig", "lab_of_mine", "single")}

    try:
        seen = look()
        assert look() == seen
        assert len(set(seen.values())) == 3
        (tmp_path / "lab_of_mine" / "more.py").write_text("x = 1")
        now = look()
        assert {name for name in seen if now[name] != seen[name]} == {"lab_of_mine"}
        (tmp_path / "rig" / "table.yaml").write_text("x: 1")
        assert {name for name in seen if look()[name] != now[name]} == {"rig", "lab_of_mine", "single"}
        (tmp_path / "rig" / "__pycache__").mkdir()
        now = look()
        (tmp_path / "rig" / "__pycache__" / "left.py").write_text("x = 1")
        (tmp_path / "rig" / "notes.txt").write_text("not code")
        assert look() == now
        monkeypatch.setattr(module, "package_versions", lambda *names: dict.fromkeys(names, "0.0.1"))
        assert set(look().values()).isdisjoint(now.values())
    finally:
        code_digest.cache_clear()


def test_the_digest_of_the_code_sees_plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "foglamp").mkdir()
    (tmp_path / "foglamp" / "__init__.py").write_text("KIND = 1")
    about = tmp_path / "foglamp-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Name: foglamp\nVersion: 1.0\n")
    without = code_digest.__wrapped__("rig")
    (about / "entry_points.txt").write_text("[spadrig.estimator]\nfoglamp = foglamp:KIND\n")
    with_it = code_digest.__wrapped__("rig")
    (tmp_path / "foglamp" / "__init__.py").write_text("KIND = 2")
    assert len({without, with_it, code_digest.__wrapped__("rig")}) == 3


def test_a_case_has_the_same_name_wherever_the_program_is_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = []
    for place in ("anna", "ben"):
        monkeypatch.setattr(module, "TOP", tmp_path / place)
        (tmp_path / place / "config").mkdir(parents=True)
        own, foreign = str(tmp_path / place / "config" / "rig.yaml"), str(tmp_path / "mine.yaml")
        made = Case("builtins:dict", {"config": {"calibration": own, "all": [own, foreign]}}, files=(own, foreign))
        assert made.files == (f"{INSTALLED}/config/rig.yaml", foreign)
        assert made.call() == {"config": {"calibration": own, "all": [own, foreign]}}
        assert made.inputs["config"]["all"] == [f"{INSTALLED}/config/rig.yaml", foreign]
        (tmp_path / place / "config" / "rig.yaml").write_text("x: 1")
        sums = {made.files[0]: checksum(made.files[0]), foreign: "sum"}
        names.append(made.name("code", sums))
        assert changed_file({made.files[0]: sums[made.files[0]]}) is None
        (tmp_path / place / "config" / "rig.yaml").write_text("x: 2")
        assert changed_file({made.files[0]: sums[made.files[0]]}) == made.files[0], "its content counts"
    assert names[0] == names[1]


def test_a_file_outside_the_program_is_not_taken_for_its_own(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("x: 1")
    around = f"{TOP}/config/../{'../' * len(TOP.parts)}{tmp_path}/rig.yaml"
    made = Case("builtins:dict", {"calibration": around}, files=(around,))
    assert made.inputs["calibration"] == around
    assert made.files == (around,)


def test_the_package_of_a_function_is_the_first_part_of_its_name() -> None:
    assert package_of("rig.api.studies.cases:scan_once") == "rig"
    assert package_of("single:main") == "single"
