"""Bare cubes: every bit is counted once, in its column; what is no cube is told what makes it one."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.model.camera import Camera
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PivotScanner, PlaneTable
from rig.api import import_frames
from rig.config.models import CubePlan
from rig.count.volume import SweepCounter, SweepLayout
from rig.errors import UsageError
from rig.recording import cube as cube_module
from rig.recording.cube import count_map, open_cube
from rig.threads import RowWorkers
from tests.stability.inventory import covers

covers(cube_module)

ROWS, WIDTH = 24, 100
UNPACKED = (np.random.default_rng(3).random((6, ROWS, WIDTH)) < 0.3).astype(np.uint8)
PACKED = np.packbits(UNPACKED, axis=2)


def plan(columns: int, exposures: int) -> CubePlan:
    return CubePlan.model_validate(
        {"columns": columns, "exposures": exposures, "frame_rate": "97.7 kHz", "depth_range": ["1 m", "8 m"]}
    )


def model(columns: int, width: int, rows: int) -> RigModel:
    matrix = np.array([[100.0, 0, (width - 1) / 2], [0, 100, (rows - 1) / 2], [0, 0, 1]])
    tangents = np.linspace(-0.2, 0.4, columns)
    planes = np.stack([np.ones(columns), 0 * tangents, -tangents, np.full(columns, -0.3)], axis=1)
    return RigModel(Camera(width, rows, matrix, np.zeros(5)), PlaneTable(np.arange(columns, dtype=float), planes))


@settings(max_examples=25, deadline=None)
@given(
    maps=st.integers(1, 3),
    columns=st.integers(1, 9),
    exposures=st.sampled_from([1, 2, 7, 255, 256, 300]),
    rows=st.integers(1, 5),
    width=st.integers(1, 140),
    chunk=st.sampled_from([1, 1000, 1 << 24]),
    seed=st.integers(0, 99),
)
def test_counts_are_the_sums_of_the_bits(
    tmp_path_factory: pytest.TempPathFactory, maps, columns, exposures, rows, width, chunk, seed
) -> None:
    rng = np.random.default_rng(seed)
    bits = rng.random((maps * columns * exposures, rows, width)) < 0.7
    file = tmp_path_factory.mktemp("cube") / "cube.npy"
    packed = np.packbits(bits, axis=-1)
    packed[:, :, -1] |= np.uint8(0xFF >> (width % 8 or 8))  # bits past the width are no pixels
    np.save(file, packed)
    cube = open_cube(file, plan(columns, exposures), model(columns, width, rows))
    assert cube.maps == maps
    window = -(-width // 64) * 64
    layout = SweepLayout(columns, rows, width, np.zeros(columns, np.int32), window, exposures)
    with RowWorkers(2) as workers, pytest.MonkeyPatch.context() as patch:
        counter = SweepCounter(layout, workers)
        patch.setattr(cube_module, "CHUNK_BYTES", chunk)
        for index in range(maps):
            volume, gaps = count_map(cube, index, counter)
            assert gaps == []
            expected = bits.reshape(maps, columns, exposures, rows, width)[index].sum(axis=1)
            assert np.array_equal(volume.counts[:, :, :width], expected)
            assert not volume.counts[:, :, width:].any()
            assert np.array_equal(volume.n_frames, np.full(columns, exposures))
            assert np.array_equal(volume.column, np.arange(columns))
            assert volume.dark_counts is None


def test_all_that_does_not_fit_is_said_at_once(tmp_path: Path) -> None:
    np.save(tmp_path / "cube.npy", np.zeros((7, 4, 13), np.uint8))
    with pytest.raises(UsageError) as caught:
        open_cube(tmp_path / "cube.npy", plan(2, 3), model(5, 100, 4))
    assert len(caught.value.problems) == 2


@pytest.mark.parametrize("command", [[0.0, 2.0], [-1.0, 0.0]])
def test_planes_at_other_commands_than_columns_do_not_fit(tmp_path: Path, command: list[float]) -> None:
    np.save(tmp_path / "cube.npy", np.zeros((6, 4, 13), np.uint8))
    camera = model(2, 100, 4).camera
    table = PlaneTable(np.array(command), np.array([[1, 0, 0, -0.3], [1, 0, -0.1, -0.3]]))
    pivot = PivotScanner(np.array([-0.3, 0, 0]), np.array([0, 1, 0]), np.array([1, 0, 0]), np.array([0, 0.3]))
    for scanner in (table, pivot):
        with pytest.raises(UsageError, match="needs 'planes', one per column"):
            open_cube(tmp_path / "cube.npy", plan(2, 3), RigModel(camera, scanner))


def refusal(file: Path, exposures: int = 3, width: int = WIDTH) -> str:
    with pytest.raises(UsageError) as caught:
        open_cube(file, plan(2, exposures), model(2, width, ROWS))
    (line,) = caught.value.problems
    return line


@pytest.mark.parametrize(
    ("array", "line"),
    [
        (UNPACKED, "numpy.packbits(frames, axis=2)"),
        (UNPACKED.astype(bool), "numpy.packbits(frames, axis=2)"),
        (UNPACKED.astype(np.int64), "numpy.packbits(frames, axis=2)"),
        (UNPACKED.astype(np.float32), "numpy.packbits(frames != 0, axis=2)"),
        (np.asfortranarray(UNPACKED), "numpy.packbits(frames, axis=2)"),
        (UNPACKED.transpose(1, 2, 0), "numpy.packbits(numpy.transpose(frames, (2, 0, 1)), axis=2)"),
        (PACKED.transpose(1, 2, 0), "numpy.transpose(frames, (2, 0, 1))"),
        (UNPACKED.transpose(0, 2, 1), "numpy.packbits(numpy.transpose(frames, (0, 2, 1)), axis=2)"),
        (PACKED.reshape(-1, ROWS * 13), "frames.reshape(-1, 24, 13)"),
        (UNPACKED.reshape(-1, ROWS * WIDTH), "numpy.packbits(frames.reshape(-1, 24, 100), axis=2)"),
        (PACKED.astype(np.int16), "frames.astype(numpy.uint8)"),
    ],
)
def test_an_array_that_is_no_cube_is_told_what_makes_it_one(tmp_path: Path, array: np.ndarray, line: str) -> None:
    np.save(tmp_path / "bad.npy", array)
    assert refusal(tmp_path / "bad.npy").endswith(f"eight pixels a byte; make it with {line}")
    assert np.array_equal(eval(line, {"numpy": np, "frames": np.load(tmp_path / "bad.npy")}), PACKED)


def bytes_of(write, *arguments, **options) -> bytes:
    """What numpy writes to a file."""
    stream = BytesIO()
    write(stream, *arguments, **options)
    return stream.getvalue()


WHOLE, ARCHIVE = bytes_of(np.save, PACKED), bytes_of(np.savez, a=PACKED, b=PACKED)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (PACKED[:0], "has 0 frames"),
        (PACKED[:5], "has 5 frames; 2 columns x 3 exposures need 6 a map"),
        (PACKED[:, :, :12], "the calibration's 100 x 24 sensor needs (frames, 24, 13)"),
        (PACKED[:, :, 0], "needs (frames, 24, 13)"),
        (PACKED[0, 0, 0], "use the calibration made with this sensor"),
        (UNPACKED[0], "make it with numpy.packbits(frames[None], axis=2)"),
        (3 * UNPACKED, "sums of several exposures are no frames"),
        (b"columns: 3", "is no whole .npy file"),
        (b"", "is no whole .npy file"),
        (WHOLE[:100], "is no whole .npy file"),
        (WHOLE[:-100], "is no whole .npy file of numbers (mmap length is greater than file size)"),
        (ARCHIVE, "is an archive of arrays; a cube is one array"),
        (bytes_of(np.save, np.array([{}, []], object), allow_pickle=True), "Python objects"),
        (None, "No such file or directory; check the path"),
    ],
    ids=range(14),
)
def test_a_file_that_is_no_cube_is_told_why(tmp_path: Path, content: np.ndarray | bytes | None, said: str) -> None:
    if content is not None:
        (tmp_path / "bad.npy").write_bytes(content if isinstance(content, bytes) else bytes_of(np.save, content))
    assert said in refusal(tmp_path / "bad.npy")


def test_imported_frames_that_are_not_the_plans_are_told_why(tmp_path: Path) -> None:
    np.save(tmp_path / "cube.npy", PACKED)
    (tmp_path / "cube.json").write_text('{"format": "spadrig-frames", "width": 100}')
    for rate in ("97.7 kHz", "50 kHz"):
        import_frames("photoncube", [tmp_path / "cube.npy"], tmp_path / rate, frame_rate=rate)
    assert open_cube(tmp_path / "97.7 kHz", plan(2, 3), model(2, WIDTH, ROWS)).maps == 1
    assert "has 6 frames; 2 columns x 2 exposures need 4 a map" in refusal(tmp_path / "97.7 kHz", 2)
    assert "was taken at 50000 Hz, the plan says 97700 Hz; correct frame_rate" in refusal(tmp_path / "50 kHz")
    wide = refusal(tmp_path / "97.7 kHz", width=160)
    assert "frames of 100 x 24 pixels, the calibration is of a sensor of 160 x 24" in wide
