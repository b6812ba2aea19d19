"""Files and requests of strangers: what `tests.campaigns.inputs` and a reader who meant harm have found."""

import json
import re
import struct
import time
import zlib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from calibration.board.board import load_board
from calibration.errors import CalibrationError
from calibration.files.npy_files import load_arrays
from drivers.errors import CommandRefused, DeviceError, ProtocolError
from drivers.replay.spad import recorded_info
from rig.api import cut, import_frames
from rig.cli.main import app
from rig.config.files import load_config
from rig.errors import DamagedRecordingError, RigError, UsageError
from rig.recording.inputs import write_inputs
from rig.recording.open import info, open_recording
from rig.recording.repair import repair
from rig.recording.verify import Integrity, verify
from rig.requests import RunsRequest
from rig.run_folder.folder import read_learned
from rig.run_folder.manifest import MANIFEST, file_crc32, read_manifest, sealed_text
from rig.run_folder.map_files import map_numbers, read_arrays, read_depth
from rig.run_folder.pictures import png_bytes, read_grey
from rig.run_folder.runs import DAMAGED, list_runs
from rig.strategies.comparison.files import COMPARISON_FILE, comparison_report
from rig.study.definition import load_study
from rig.tradeoff.files import TRADEOFF_FILE, tradeoff_report
from rig.view.access import Access, Asked
from rig.view.pages import PageWish
from sim_backend.scenes.scene import SceneFile, load_scene, load_surfaces
from tests.campaigns.inputs import wires
from tests.campaigns.inputs.recordings import learned_seeds
from tests.unit.rig.count.streams import plan_of, rig_model, scan
from tests.unit.rig.recording.recorded import record, run_blocks

ENDLESS = "1e999999999"
"""Text that `Fraction` reads, for minutes."""


def recording(folder: Path, **manifest: Any) -> Path:
    """A recording whose manifest says what it likes, with the right seal."""
    write_inputs(record(folder, [run_blocks()], **manifest), plan_of(scan()), rig_model())
    return folder


def test_a_manifest_copies_no_file_from_or_to_elsewhere(tmp_path: Path) -> None:
    secret = tmp_path / "payload"
    secret.write_text("anything")
    for name in ("../payload", str(secret), "..", "a/b", ""):
        folder = recording(tmp_path / f"run-{len(name)}", inputs={name: file_crc32(secret)})
        with pytest.raises(RigError, match=r"manifest\.json: inputs"):
            cut(folder, tmp_path / "out" / "part", maps="0:1")
        assert verify(folder).verdict is Integrity.DAMAGED
    assert not (tmp_path / "out" / "payload").exists()


def test_what_is_no_file_is_not_read_to_its_end(tmp_path: Path) -> None:
    folder = recording(tmp_path / "run", inputs={"zero": 0})
    (folder / "zero").symlink_to("/dev/zero")
    assert "zero cannot be read: zero is no file" in verify(folder).problems


@pytest.mark.parametrize("time_of_day", [[], {"starts": 5}, {"starts": ["a"]}])
def test_times_of_another_form_are_damage(tmp_path: Path, time_of_day: object) -> None:
    folder = recording(tmp_path, time=time_of_day)
    with pytest.raises(DamagedRecordingError, match=r"manifest\.json: time"):
        read_manifest(folder)
    assert info(folder).maps


@pytest.mark.parametrize("taken", ["0001-01-01T00:00:00+23:59", "9999-12-31T23:59:59-23:59"])
def test_a_run_from_the_end_of_time_is_listed(tmp_path: Path, taken: str) -> None:
    recording(tmp_path / "run", rig={"taken": taken})
    (entry,) = list_runs(tmp_path, RunsRequest())
    assert entry.verdict == "complete"


def test_a_manifest_that_is_no_utf_8_at_heart_is_listed_as_damaged(tmp_path: Path) -> None:
    folder = recording(tmp_path / "run")
    (folder / MANIFEST).write_text(sealed_text(json.dumps({"note": "a", "rig": {"kinds": {"\x1b[2J": "a"}}})))
    (entry,) = list_runs(tmp_path, RunsRequest())
    assert entry.verdict == DAMAGED
    assert entry.problem.isprintable()


def test_a_fraction_as_text_takes_no_time(tmp_path: Path) -> None:
    begun_s = time.process_time()
    described = {
        "model": "m", "serial": "0", "width": 64, "height": 4, "rotation_deg": 0, "max_frame_rate_hz": ENDLESS,
        "burst": None, "stream": None, "roi_step_px": 64, "markers": True, "trigger_modes": [],
    }  # fmt: skip
    folder = recording(tmp_path / "run", devices={"spad": {"info": described}})
    with pytest.raises(ProtocolError, match=r"no description of a SPAD"):
        recorded_info(open_recording(folder))
    np.save(tmp_path / "cube.npy", np.full((3, 2, 2), 7, np.uint8))
    clock = {"tick_hz": [100_000_000, 1], "frame_period_ticks": ENDLESS}
    (tmp_path / "cube.json").write_text(json.dumps({"format": "spadrig-frames", "width": 16, "clock": clock}))
    assert import_frames("photoncube", [tmp_path / "cube.npy"], tmp_path / "import").frame_rate_hz is None
    assert time.process_time() - begun_s < 5.0


@pytest.mark.parametrize(
    "change", [{"rows": []}, {"ci95_by": 1}, {"versions": [1]}, {"scene": 0.5}, {"mean_abs_px": 1e308}, {"ci95": [1]}]
)
def test_a_trade_off_with_other_content_is_refused(tmp_path: Path, change: dict[str, object]) -> None:
    row = {
        "scene": "street", "fog": None, "estimator": "joint", "filter": "none", "exposures": 5, "lines": 1,
        "sensor_ms": 5.0, "compute_ms": 3.0, "mean_abs_px": 0.1, "within_1px": 0.9, "missing": 0.0, "depth_mm": 5.0,
        "ci95": [0.09, 0.11],
    }  # fmt: skip
    content = {"rows": [row | {key: value for key, value in change.items() if key in row}], "verdict": "complete"}
    content |= {"advice": "take joint", "ci95_by": "blocks", "versions": {}}
    file = tmp_path / TRADEOFF_FILE
    file.write_text(json.dumps(content))
    assert change.keys() & row.keys() or tradeoff_report(tmp_path)
    file.write_text(json.dumps(content | {key: value for key, value in change.items() if key not in row}))
    with pytest.raises(UsageError, match="is no trade-off of this version"):
        tradeoff_report(tmp_path)


@pytest.mark.parametrize(
    "change", [{"rows": []}, {"notes": 1}, {"versions": [1]}, {"scene": 0.5}, {"light": "torch"}, {"mean_px": "much"},
               {"seconds": {"line-joint": 3}}],
)  # fmt: skip
def test_a_comparison_with_other_content_is_refused(tmp_path: Path, change: dict[str, object]) -> None:
    row = {
        "strategy": "line-joint", "light": "line", "scene": "<i>street", "air": "20m", "rule": "energy",
        "time_ms": 50.0, "pixels": 100, "mean_px": 0.1, "good": 0.9, "confident_wrong": 0.0, "valid": 0.9,
    }  # fmt: skip
    content = {"rows": [row | {key: value for key, value in change.items() if key in row}], "verdict": "complete"}
    content |= {"notes": [], "strategies": {}, "seconds": {}, "versions": {}}
    file = tmp_path / COMPARISON_FILE
    file.write_text(json.dumps(content))
    assert change.keys() & row.keys() or "<i>" not in comparison_report(tmp_path)
    file.write_text(json.dumps(content | {key: value for key, value in change.items() if key not in row}))
    with pytest.raises(UsageError, match="is no comparison of this version"):
        comparison_report(tmp_path)


def test_a_comparison_of_numbers_that_cannot_be_drawn_is_refused(tmp_path: Path) -> None:
    row = {"strategy": "line-joint", "light": "line", "scene": "s", "air": "20m", "rule": "energy", "pixels": 100}
    odd = ((0.0, 0.1), (-5.0, 1e308), (1e-300, 0.0), (1e300, -1.0))
    rows = [row | {"time_ms": ms, "mean_px": px, "good": 2.0, "confident_wrong": -1.0} for ms, px in odd]
    content = {"rows": rows, "verdict": "?", "notes": [], "strategies": {}, "seconds": {}, "versions": {}}
    (tmp_path / COMPARISON_FILE).write_text(json.dumps(content))
    with pytest.raises(UsageError, match="is no comparison of this version"):
        comparison_report(tmp_path)


@pytest.mark.parametrize("scene", ["[street]", "{a: 1}"])
def test_a_scene_that_is_no_text_is_a_mistake_like_any_other(tmp_path: Path, scene: str) -> None:
    (tmp_path / "rig.yaml").write_text(f"world: {{kind: simulated, scene: {scene}}}\n")
    with pytest.raises(UsageError, match=r"world\.scene is"):
        load_config(tmp_path / "rig.yaml")


@pytest.mark.parametrize("path", ["//[", "/?token=%ff", "/?token=\udcff", "http://[", "/#a"])
@pytest.mark.parametrize("cookie", ["spadrig-8765=\udcff\udc80", "spadrig-8765=", "\udcff"])
def test_a_request_of_odd_bytes_is_refused_like_any_other(path: str, cookie: str) -> None:
    lab = Access("0.0.0.0", 8765, "a-token-that-is-long-enough", frozenset({"localhost"}))
    refusal = lab.refusal(Asked(path, False, ["localhost"], [], [cookie]))
    assert refusal is not None
    assert refusal.status == 401


@pytest.mark.parametrize("least", ["9" * 400, "1e999", "-" + "9" * 400])
def test_a_number_beyond_all_bounds_is_no_wish(least: str) -> None:
    with pytest.raises(ValueError):
        PageWish.parse(1, f'{{"ask": "confidence", "least": {least}}}')


@pytest.mark.parametrize("name", ["manifest.json.part", "frames.idx.part", "frames-000000.torn"])
def test_a_repair_follows_no_link_to_another_file(tmp_path: Path, name: str) -> None:
    folder = recording(tmp_path / "run")
    for file in (folder / MANIFEST, folder / "frames.idx"):
        file.write_bytes(file.read_bytes()[:-40])
    with (folder / "frames-000000.spb").open("ab") as segment:
        segment.write(b"x" * 100)
    for exists in (True, False):
        victim = tmp_path / f"victim-{exists}"
        if exists:
            victim.write_text("mine")
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(victim)
        repair(folder)
        assert victim.exists() == exists
        assert not exists or victim.read_text() == "mine"


def test_a_repair_changes_no_file_elsewhere(tmp_path: Path) -> None:
    folder, other = recording(tmp_path / "run"), recording(tmp_path / "other")
    segment, target = folder / "frames-000000.spb", other / "frames-000000.spb"
    with target.open("ab") as file:
        file.write(b"x" * 100)
    before = target.read_bytes()
    segment.unlink()
    segment.symlink_to(target)
    with pytest.raises(UsageError, match=r"frames-000000\.spb is a link, .*repair a copy"):
        repair(folder)
    assert target.read_bytes() == before


def _picture(change: str) -> bytes:
    """A small picture whose header says something else, with the right checksum."""
    png = bytearray(png_bytes(np.zeros((4, 8), np.uint8)))
    if change == "pixels":
        struct.pack_into(">II", png, 16, 60_000, 60_000)
        struct.pack_into(">I", png, 29, zlib.crc32(png[12:29]))
    if change == "chunk":
        struct.pack_into(">I", png, 33, 0x7F000000)
    return bytes(png)


def test_a_picture_takes_no_more_memory_than_a_map_has(tmp_path: Path) -> None:
    file = tmp_path / "000000.png"
    file.write_bytes(_picture(""))
    assert read_grey(file).shape == (4, 8)
    for change in ("pixels", "chunk"):
        file.write_bytes(_picture(change))
        with pytest.raises(ValueError, match="no picture"):
            read_grey(file)


def test_numbers_of_maps_that_mean_nothing_are_no_estimate(tmp_path: Path) -> None:
    file = tmp_path / "depth.npy"
    np.save(file, np.array([[1.0, 1e300, -np.inf, np.nan]]))
    assert np.array_equal(read_depth(file), np.float32([[1, np.nan, np.nan, np.nan]]), equal_nan=True)
    for array in (np.array([["a"]]), np.zeros((1, 1), [("a", "u1")])):
        np.save(file, array)
        with pytest.raises(ValueError, match="no numbers"):
            read_depth(file)
    np.savez(tmp_path / "worth.npz", confidence=np.array([[0.5, 1e30]]))
    assert np.isnan(read_arrays(tmp_path / "worth.npz")["confidence"]).tolist() == [[False, True]]


def test_a_file_named_by_a_superscript_is_no_map(tmp_path: Path) -> None:
    (tmp_path / "stripe").mkdir()
    for name in ("000001", "\u00b2", "\u0663", "x"):
        (tmp_path / "stripe" / f"{name}.npz").touch()
    assert map_numbers(tmp_path) == [1]


@pytest.mark.parametrize("command", ["runs", "info", "verify", "report", "doctor"])
@pytest.mark.parametrize("options", [[], ["--json"]])
def test_words_of_strangers_command_no_terminal(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], command: str, options: list[str]
) -> None:
    evil = "\x1b[2J\x9b31m\x07[/bold] [link=http://evil.example]see\u202e <script>\r"
    devices = {"spad": {"identity": evil, "name": evil}}
    folder = recording(tmp_path / "run", note=evil, tags=[evil], command=evil, devices=devices, config={"name": evil})
    (folder / "summary.json").write_text(json.dumps({"estimator": evil, "verdict": evil}))
    if command == "doctor":
        folder = tmp_path / "rig.yaml"
        folder.write_text(yaml.safe_dump({"name": evil, "world": {"kind": evil, "scene": evil}}))
    with pytest.raises(SystemExit):
        app([command, str(tmp_path if command == "runs" else folder), *options])
    said = "".join(capfd.readouterr())
    assert said
    assert not set(said) & set("\x1b\x9b\x07\u202e\r")
    page = tmp_path / "run-report.html"
    assert page.exists() == (command == "report")
    assert not page.exists() or "<script>" not in page.read_text()


def refused(parse: Any, answers: list[bytes]) -> DeviceError:
    """The error that a driver ends with on these answers, in one line that a terminal can show."""
    with pytest.raises(DeviceError) as ended:
        parse(wires.pack(answers))
    assert str(ended.value).isprintable()
    return ended.value


def test_an_answer_without_its_second_half_is_a_wrong_answer() -> None:
    target = next(target for target in wires.TARGETS if target.name == "prawndo")
    halved = partial(re.sub, rb"run-status:\d clock-status:\d", b"run-status clock-status")
    answers = list(map(halved, wires.unpack(target.seeds()[0])))
    assert b"run-status clock-status" in b"".join(answers)
    assert isinstance(refused(target.parse, answers), ProtocolError)


def test_an_endless_version_is_none() -> None:
    target = next(target for target in wires.TARGETS if target.name == "pulsestreamer")
    answers = [each.replace(b"1.7.0", b"9" * 5000 + b".7.0") for each in wires.unpack(target.seeds()[0])]
    assert "no version" in str(refused(target.parse, answers))


def test_numbers_of_a_spad512s_are_finite() -> None:
    target = next(target for target in wires.TARGETS if target.name == "spad512s")
    answers = [each.replace(b"1e6", b"nan") for each in wires.unpack(target.seeds()[0])]
    assert isinstance(refused(target.parse, answers), ProtocolError)


def test_words_of_a_device_command_no_terminal() -> None:
    target = next(target for target in wires.TARGETS if target.name == "cobolt")
    answers = list(wires.unpack(target.seeds()[0]))
    for each in range(len(answers)):
        with_escape = [*answers[:each], *[b"Syntax error: \x1b[2J\x07\r\n"] * 6, *answers[each:]]
        if isinstance(refused(target.parse, with_escape), CommandRefused):
            return
    pytest.fail("no answer was taken for a refusal")


def test_strings_of_a_usb_device_command_no_terminal() -> None:
    target = next(target for target in wires.TARGETS if target.name == "usb-strings")
    target.parse(wires.pack([text.encode("utf-16-le") for text in ("\x1b[2J", "SPB1\n\u2028")]))


@pytest.mark.parametrize("name", ["~no-such-user/scene.yaml", "a\0b", "a" * 300])
def test_a_path_that_leads_nowhere_is_a_mistake_like_any_other(tmp_path: Path, name: str) -> None:
    with pytest.raises(DeviceError, match="is no file, no folder and none of the bundled"):
        load_scene(name)
    scene = SceneFile(surfaces=name)
    with pytest.raises(DeviceError, match="is no folder"):
        load_surfaces(scene, tmp_path, np.zeros((2, 2)), np.zeros((2, 2)))
    with pytest.raises(CalibrationError, match="cannot read board"):
        load_board(name)
    study = tmp_path / "study.yaml"
    study.write_text(yaml.safe_dump({"do": "scan", "vary": {"scene": [name]}}))
    assert load_study(study).vary == {"scene": [str(tmp_path / name) if "/" in name else name]}


@pytest.mark.parametrize(
    "change",
    [
        {"row_gain": np.ones(4)},
        {"ambient": np.zeros((4, 64), "<U4")},
        {"column_gain": np.ones((20, 1), np.float32)},
        {"before": np.zeros((1, 4, 20), np.uint16)},
        {"line_sigma_px": np.float64(1e9)},
        {"line_sigma_px": np.float64(np.nan)},
        {"per_w": np.float64(0)},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_learned_state_has_the_form_that_kernels_read(tmp_path: Path, change: dict[str, Any]) -> None:
    (tmp_path / "learned.npz").write_bytes(learned_seeds()[0])
    arrays = load_arrays(tmp_path / "learned.npz")
    assert read_learned(tmp_path / "learned.npz").line_sigma_px == 0.5
    np.savez(tmp_path / "learned.npz", **{**arrays, **change})
    with pytest.raises(UsageError, match=f"holds nothing that joint has learned \\({next(iter(change))} is "):
        read_learned(tmp_path / "learned.npz")


def test_words_beside_a_photon_cube_command_no_terminal(tmp_path: Path) -> None:
    np.save(tmp_path / "cube.npy", np.full((3, 2, 2), 7, np.uint8))
    for beside in (
        {"format": "spadrig-frames", "width": "\r\x1b[2J"},
        {"file_path": "cube.npy", "bitpack": True, "bitpack_dim": "\x1b[2J"},
    ):
        (tmp_path / "transforms.json").write_text(json.dumps(beside))
        with pytest.raises(UsageError) as refused:
            import_frames("photoncube", [tmp_path / "cube.npy"], tmp_path / "import")
        assert str(refused.value).isprintable()
