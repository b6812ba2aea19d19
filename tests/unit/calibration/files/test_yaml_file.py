"""The one reader of YAML files: what multiplies, nests, repeats or lies is refused in one line, by every file."""

import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from calibration.board.board import load_board
from calibration.errors import CalibrationError, FileError
from calibration.files import sections as yaml_file
from calibration.files.problems import MAX_PROBLEMS
from calibration.files.rig_file import load_camera, load_rig_model
from calibration.files.sections import MAX_DEPTH, load_yaml
from drivers.errors import DeviceError
from rig.config.files import load_config, load_cube_plan
from rig.errors import UsageError
from rig.recording.inputs import read_plan
from sim_backend.scenes.scene import load_scene

ROOT = Path(__file__).parents[4]
LAUGHS = "\n".join(
    ["a0: &a0 [ha, ha, ha, ha, ha, ha, ha, ha, ha]"]
    + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 9)]
)
"""Nine lines of a billion values."""
READERS: dict[str, Callable[[Path], object]] = {
    "calibration": load_rig_model,
    "camera": load_camera,
    "board": load_board,
    "scene": lambda file: load_scene(str(file)),
    "config": load_config,
    "cube plan": load_cube_plan,
    "recorded plan": lambda file: read_plan(file.parent, file.name),
}


def read(folder: Path, text: str) -> dict[str, Any]:
    file = folder / "file.yaml"
    file.write_text(text, encoding="utf-8")
    return load_yaml(file, "a board", "kind: charuco").content


@pytest.mark.parametrize("reader", READERS.values(), ids=READERS)
@pytest.mark.parametrize(
    ("text", "said"),
    [
        (LAUGHS, "aliases repeat more than 100000 values"),
        ("provenance: &a {again: *a}", r"'\*a' stands within what it repeats"),
        (f"provenance: {'[' * 500}{']' * 500}", "nested more than 64 deep"),
        ("format: x\nformat: y", r":2: 'format' is given twice"),
        ("", "is empty"),
    ],
    ids=["laughs", "itself", "deep", "twice", "empty"],
)
def test_every_file_is_read_within_limits(
    tmp_path: Path, reader: Callable[[Path], object], text: str, said: str
) -> None:
    file = tmp_path / "file.yaml"
    file.write_text(text)
    with pytest.raises((CalibrationError, UsageError, DeviceError), match=said) as refused:
        reader(file)
    assert "\n" not in str(refused.value)
    assert "file.yaml" in str(refused.value)


def test_there_is_one_reader_of_yaml() -> None:
    calls = re.compile(r"yaml\.(safe_load|load|full_load|unsafe_load|compose|parse)\w*\(|\w*SafeLoader\b")
    files = (file for part in ("drivers", "calibration", "sim_backend", "rig") for file in (ROOT / part).rglob("*.py"))
    found = {str(file.relative_to(ROOT)) for file in files if calls.search(file.read_text(encoding="utf-8"))}
    assert found == {"calibration/files/sections.py"}


def test_a_chain_of_aliases_nests_as_deep_as_what_it_stands_for(tmp_path: Path) -> None:
    links = [f"a{i}: &a{i} [*a{i - 1}]" for i in range(1, MAX_DEPTH)]
    with pytest.raises(CalibrationError, match="nested more than 64 deep"):
        read(tmp_path, "\n".join(["a0: &a0 [1]", *links]))
    assert len(read(tmp_path, "\n".join(["a0: &a0 [1]", *links[: MAX_DEPTH // 2]]))) == MAX_DEPTH // 2 + 1


def test_anchors_and_merged_keys_that_stay_small_are_read(tmp_path: Path) -> None:
    content = read(tmp_path, "a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}\nc: [*a, *a]")
    assert content == {"a": {"x": 1, "y": 2}, "b": {"x": 1, "y": 3}, "c": [{"x": 1, "y": 2}] * 2}


def test_values_and_bytes_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = f"a: [{', '.join('1' * 100)}]"
    monkeypatch.setattr(yaml_file, "MAX_NODES", 103)  # the file, its key, the list and its items
    assert len(read(tmp_path, text)["a"]) == 100
    monkeypatch.setattr(yaml_file, "MAX_NODES", 102)
    with pytest.raises(CalibrationError, match="more than 102 values"):
        read(tmp_path, text)
    monkeypatch.setattr(yaml_file, "MAX_BYTES", len(text) - 1)
    with pytest.raises(CalibrationError, match=r"has 0 MB, a board has at most"):
        read(tmp_path, text)


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("2024-13-45", "2024-13-45 is no timestamp"),
        ("!!int many", "many is no int"),
        ("!!bool perhaps", "perhaps is no bool"),
        ("1" * 5000, r"1{40}\.\.\. is no int"),
        ("0x" + "f" * 5000, "is too large, a whole number is below 2^64"),
        ("18446744073709551616", "is too large"),
        ("!!python/object/apply:os.getcwd []", "could not determine a constructor"),
        ("\x07", "not YAML"),
        ("1" + ":1" * 300_000, r"1:1:1.*\.\.\. is no int"),
        ("!!int '\\x1b[2J many\n\n words'", r"is no int"),
        ("!!float [1]", "not YAML"),
    ],
)
def test_a_value_that_is_none_is_one_line(tmp_path: Path, value: str, said: str) -> None:
    with pytest.raises(CalibrationError, match=said.replace("^", r"\^")) as refused:
        read(tmp_path, f"a: {value}")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("key", "said"),
    [(r'"\e[2J"', r"the key '\\x1b\[2J' has characters that cannot be shown"), ('"a\\nb"', "cannot be shown"),
     ("k" * 201, "has over 200 characters")],
)  # fmt: skip
def test_a_key_can_be_shown_in_a_line(tmp_path: Path, key: str, said: str) -> None:
    with pytest.raises(CalibrationError, match=said) as refused:
        read(tmp_path, f"a: {{? {key} : 1}}")
    assert str(refused.value).isprintable()


def test_a_file_full_of_mistakes_is_told_in_no_time_by_its_first_ones(tmp_path: Path) -> None:
    file = tmp_path / "calibration.yaml"
    wrong = ", ".join(["1"] * 20_000)  # a text in each place was expected
    file.write_text(f"format: spadrig-calibration\nversion: 1\nprovenance: {{corners: [{wrong}]}}\n")
    begun_s = time.process_time()
    with pytest.raises(FileError, match="'camera' is missing") as refused:
        load_rig_model(file)
    assert len(refused.value.problems) == MAX_PROBLEMS + 1
    assert refused.value.problems[-1].endswith("19901 more problems; is it a file of another kind?")
    file.write_text("".join(f"key{i}: 1\n" * 2 for i in range(5000)))
    with pytest.raises(FileError, match="is given twice") as refused:
        load_rig_model(file)
    assert len(refused.value.problems) == MAX_PROBLEMS + 1
    assert time.process_time() - begun_s < 5.0  # it took a time with the square of their number: minutes


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path: Path) -> None:
    assert read(tmp_path, "\ufeffkind: charuco") == {"kind": "charuco"}
