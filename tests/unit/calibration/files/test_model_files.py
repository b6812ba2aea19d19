"""The files of a calibration and of a camera: what is written is read back, what is wrong said in one line."""

import contextlib
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from calibration.errors import CalibrationError
from calibration.files import problems, sections
from calibration.files.npy_files import load_array, load_arrays
from calibration.files.rig_file import KnownCamera, camera_file_text, load_camera, load_rig_model, save_rig_model
from calibration.model.camera import Camera
from calibration.model.rig_model import Covariance, Identity, Lag, RigModel
from calibration.model.scanner import PivotScanner, PlaneTable
from calibration.verdict import Verdict, reason_for
from tests.stability.inventory import covers
from tests.unit.calibration.cameras import MATRIX, camera

covers(sections, problems, load_array, load_arrays)

BUNDLED = Path(__file__).parents[4] / "config" / "simulated-rig.yaml"
HEAD = "format: spadrig-calibration\nversion: 1\n"
CAMERA = (
    "camera: {width: 512, height: 512, matrix: [[600, 0, 255.5], [0, 600, 255.5], [0, 0, 1]], "
    "distortion: [-0.1, 0, 0, 0, 0]}\n"
)
ROWS = "planes: [[1, 0, 0.3, -0.3], [1, 0, 0, -0.3], [1, 0, -0.3, -0.3]]\n"


def write(folder: Path, text: str) -> Path:
    file = folder / "calibration.yaml"
    file.write_text(text)
    return file


def pivot() -> PivotScanner:
    return PivotScanner(
        np.array([-0.3, 0, 0.01]), np.array([0.01, 1, 0]), np.array([1, 0, 0]), np.array([0.1, 0.4, 1e-3])
    )


def table() -> PlaneTable:
    return PlaneTable(np.array([-1, 0, 0.7]), np.array([[1, 0, 0.3, -0.3], [1, 0, 0, -0.3], [1, 0.1, -0.3, -0.3]]))


def test_the_bundled_rig_sweeps_its_stated_tangents() -> None:
    model = load_rig_model(BUNDLED)
    planes = model.planes([-1, 1])
    assert np.allclose(-planes[:, 2] / planes[:, 0], [-0.476, 0.712], atol=5e-4)
    assert np.allclose(planes[:, 3] / planes[:, 0], -0.3)
    assert model.lag_s == Lag(2e-4, 2e-4)
    assert model.source_m is not None
    model.check_sensor(512, 512)


def same(one: object, other: object) -> bool:
    """Whether two parts of a model are equal to the last bit."""
    if is_dataclass(one):
        given = [field.name for field in fields(one) if field.init]
        return type(one) is type(other) and all(same(getattr(one, name), getattr(other, name)) for name in given)
    return np.array_equal(one, other) if isinstance(one, np.ndarray) else one == other


PLAIN = RigModel(
    camera=camera([-0.3, 0.1, 0.001, 0.001, 0.01]), scanner=table(), lag_s=Lag(1e-4, 3e-4),
    speed_range_per_s=(10.0, 400.0), source_m=np.array([-0.3, 0, 0]), defects=np.eye(512, dtype=bool),
    provenance={"rig": "bench", "velocities_per_s": [-35.2, 35.2], "residual_px": 0.1},
)  # fmt: skip
FULL = RigModel(
    camera([-0.1, 0, 0, 0]), replace(pivot(), offset_m=np.array([1e-3, 1 / 3]), cone_rad=0.01, bow_per_rad=-0.02),
    dark_rate_per_s=np.full((512, 512), 1 / 3, np.float32), row_delay_s=1e-8, gate_delay_s=2e-6, colour_skew_s=-1e-6,
    marker_rising=False, covariance=Covariance(("fx", "axis_shift_1"), np.array([[0.04, 1e-5], [1e-5, 1e-8]])),
    identity=Identity("0f3a", "2026-11-22T10:00:00+00:00", "bench", {"spad": "usb"}, {"spad": "7"}, "failed", ("a",)),
)  # fmt: skip


@pytest.mark.parametrize("model", [PLAIN, FULL, RigModel(camera([]), pivot())], ids=["table", "full", "bare"])
def test_what_is_saved_is_read_back(tmp_path: Path, model: RigModel) -> None:
    save_rig_model(model, tmp_path / "rig.yaml")
    again = load_rig_model(tmp_path / "rig.yaml")
    assert same(again, model)
    assert again.fingerprint() == model.fingerprint()
    assert not list(tmp_path.glob(".*"))


def test_files_and_fingerprints_of_models_without_all_that_are_what_they_were(tmp_path: Path) -> None:
    model = load_rig_model(BUNDLED)
    assert model.fingerprint() == "3dadb6d2d7bf9dff"
    save_rig_model(model, tmp_path / "rig.yaml")
    kept = yaml.safe_load((tmp_path / "rig.yaml").read_text())
    assert list(kept) == ["format", "version", "camera", "scanner", "lag_s", "source_m", "provenance"]
    assert list(kept["scanner"]["pivot"])[-1] == "command_range"


def test_the_fingerprint_changes_with_what_depth_depends_on() -> None:
    base = RigModel(camera([]), table())
    others = [
        RigModel(camera([-1e-6, 0, 0, 0]), table()),
        RigModel(camera([]), pivot()),
        RigModel(camera([]), table(), lag_s=Lag(1e-6, 0)),
        RigModel(Camera(512, 511, MATRIX, np.zeros(0)), table()),
        RigModel(camera([]), table(), row_delay_s=1e-9),
        RigModel(camera([]), PlaneTable(np.array([-1, 0.1, 0.7]), table().rows)),
        *(
            RigModel(camera([]), replace(pivot(), bow_per_rad=0.01), source_m=at)
            for at in (None, np.array([0, 1e-3, 0]))
        ),
    ]
    assert len({model.fingerprint() for model in [base, *others]}) == 9
    assert RigModel(camera([]), table(), gate_delay_s=1e-6).fingerprint() == base.fingerprint()
    assert RigModel(camera([]), table()).fingerprint() == base.fingerprint()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty; a calibration must hold keys and values, e.g. 'format: spadrig-calibration'"),
        ("just: text", "first entry must be"),
        ("format: spadrig-calibration\nversion: 2\n", "has version 2; this program reads version 1"),
        (HEAD + ROWS, "'camera' is missing"),
        (HEAD + CAMERA, "exactly one of 'planes' and 'scanner'"),
        (HEAD + CAMERA + "scanner: {}\n", "exactly one of 'table' and 'pivot'"),
        (HEAD + CAMERA + ROWS + "plane: 3\n", "unknown key 'plane'"),
        (HEAD + CAMERA.replace("512", "wide", 1) + ROWS, "camera.width is 'wide'"),
        (HEAD + CAMERA.replace("-0.1, ", "") + ROWS + "lag_s: {forward: .nan}\n", "lag_s.forward is nan"),
        (HEAD + CAMERA.replace("-0.1, 0", "0") + "planes: none.npy\n", "does not exist"),
        (HEAD + CAMERA + "planes: [[1, 0, 0]]\n", "planes.0"),
        (HEAD + CAMERA + "planes: []\n", "nx, ny, nz, d"),
        (HEAD + CAMERA + "planes: [[0.5, 0.6, 0, 1]]\n", "degrees from the search axis"),
        (HEAD + CAMERA.replace("[-0.1, 0, 0, 0, 0]", "[1, 2]") + ROWS, "distortion has 2 terms"),
        (HEAD + CAMERA + ROWS + "defects: planes.npy\n", "it must be bool"),
        (HEAD + CAMERA + ROWS + "lag_s: {forward: -1.0}\n", "lag_s is"),
        (HEAD + CAMERA + ROWS + "row_delay_s: .inf\n", "row_delay_s is inf"),
        (HEAD + CAMERA + ROWS + "dark_rate: planes.npy\n", "dark rate map is 4 x 3 pixels"),
        (HEAD + CAMERA + ROWS + "covariance: {names: [fx], file: planes.npy}\n", "shape (3, 4) for 1 names"),
        (
            HEAD + CAMERA + ROWS + "covariance: {names: [bow], file: one.npy}\n",
            "the model has no parameter bow; it has fx",
        ),
        (HEAD + CAMERA + ROWS + "identity: {rig: a, created: b, verdict: fine}\n", "identity.verdict is 'fine'"),
        (HEAD + CAMERA + ROWS + "provenance: {velocities_per_s: fast}\n", "provenance.velocities_per_s is 'fast'"),
        (HEAD + CAMERA + ROWS + "provenance: {corners: 35.2}\n", "provenance.corners is 35.2"),
    ],
)
def test_a_bad_file_is_refused_in_one_line_that_names_it(tmp_path: Path, text: str, said: str) -> None:
    np.save(tmp_path / "planes.npy", np.zeros((3, 4)))
    np.save(tmp_path / "one.npy", np.ones((1, 1)))
    file = write(tmp_path, text)
    with pytest.raises(CalibrationError) as caught:
        load_rig_model(file)
    message = str(caught.value)
    assert said in message
    assert str(file) in message
    assert "\n" not in message


def test_an_absent_or_binary_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"cannot read calibration .*; check the path"):
        load_rig_model(tmp_path / "absent.yaml")
    (tmp_path / "planes.npy").write_bytes(b"\x93NUMPY\xff\xfe")
    with pytest.raises(CalibrationError, match="is not text"):
        load_rig_model(tmp_path / "planes.npy")


def test_another_sensor_and_another_speed_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "planes.npy", [[1, 0, 0.3, -0.3], [1, 0, 0, -0.3], [1, 0, -0.3, -0.3]])
    model = load_rig_model(write(tmp_path, HEAD + CAMERA + "planes: planes.npy\nspeed_range_per_s: [10, 100]\n"))
    assert model.scanner.command_range == (0, 2)
    model.check_speed(50)
    with pytest.raises(CalibrationError, match="outside the 10 to 100 /s"):
        model.check_speed(200)
    with pytest.raises(CalibrationError, match="512 x 512 pixels, this one has 320 x 240"):
        model.check_sensor(320, 240)


def test_planes_along_the_search_axis_are_refused_whatever_their_sign() -> None:
    for angle, fits in ((44, True), (46, False), (-44, True), (-46, False), (136, True), (134, False)):
        normal = [np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0, -0.3]
        scanner = PlaneTable(np.zeros(1), np.array([normal]))
        if fits:
            RigModel(camera([]), scanner)
        else:
            with pytest.raises(CalibrationError, match=r"44\.0 degrees from the search axis"):
                RigModel(camera([]), scanner)


KNOWN = Covariance(("fx", "fy"), np.diag([0.04, 0.09]))


def read_back(folder: Path, text: str) -> KnownCamera:
    file = folder / "camera.yaml"
    file.write_text(text)
    return load_camera(file)


@pytest.mark.parametrize("codes", [(), ("no-tilt", "poor-coverage")])
def test_the_verdict_and_its_reasons_are_read_back_with_the_camera(tmp_path: Path, codes: tuple[str, ...]) -> None:
    verdict = Verdict(not codes, tuple(reason_for(code, "said") for code in codes))
    lens = camera([-0.1, 0.02, 0, 0, 0])
    known = read_back(tmp_path, camera_file_text(lens, KNOWN, ["0" * 16], verdict))
    assert (known.verdict, known.reasons) == ("failed" if codes else "passed", codes)
    assert np.array_equal(known.camera.distortion, lens.distortion)
    assert known.views == {"0" * 16}


def test_a_file_of_old_is_one_that_nobody_judged(tmp_path: Path) -> None:
    text = camera_file_text(camera([]), KNOWN, [], Verdict(True))
    known = read_back(tmp_path, text.replace("verdict: passed\n", ""))
    assert (known.verdict, known.reasons) == (None, ())
    with pytest.raises(CalibrationError, match="verdict is 'good'"):
        read_back(tmp_path, text.replace("verdict: passed\n", "verdict: good\n"))
    ragged = text.replace("[0.0, 0.09]", "[0.0]")
    assert ragged != text
    with pytest.raises(CalibrationError, match=r"camera\.yaml: .*inhomogeneous"):
        read_back(tmp_path, ragged)


@pytest.mark.parametrize(("read", "write_it"), [(load_array, np.save), (load_arrays, np.savez_compressed)])
def test_whatever_is_damaged_in_an_array_or_archive_is_one_kind_of_error(
    tmp_path: Path, read: Callable[[Path], object], write_it: Callable[..., None]
) -> None:
    file = tmp_path / "file"
    with file.open("wb") as stream:
        write_it(stream, np.arange(8.0))
    whole = file.read_bytes()
    for at in range(len(whole)):
        for bit in (1, 8, 32):
            file.write_bytes(whole[:at] + bytes([whole[at] ^ bit]) + whole[at + 1 :])
            with contextlib.suppress(ValueError):
                read(file)
        file.write_bytes(whole[:at])
        with pytest.raises(ValueError, match=r"^[^\n]+$"):
            read(file)
