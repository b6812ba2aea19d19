"""Bare cubes: every bit is counted once, in its column, whatever the sizes."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration import Camera, PivotScanner, PlaneTable, RigModel
from rig.config.models import CubePlan
from rig.count.volume import SweepCounter, SweepLayout
from rig.errors import UsageError
from rig.recording import cube as cube_module
from rig.recording.cube import ArrayFrames, column_commands, count_map, open_cube
from rig.threads import RowWorkers
from tests.stability.inventory import covers

covers(cube_module)


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
    tmp_path_factory: pytest.TempPathFactory,
    maps: int,
    columns: int,
    exposures: int,
    rows: int,
    width: int,
    chunk: int,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    bits = rng.random((maps * columns * exposures, rows, width)) < 0.7
    file = tmp_path_factory.mktemp("cube") / "cube.npy"
    np.save(file, np.packbits(bits, axis=-1))
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


def test_a_cube_is_not_read_before_it_is_counted(tmp_path: Path) -> None:
    np.save(tmp_path / "cube.npy", np.zeros((6, 4, 13), np.uint8))
    cube = open_cube(tmp_path / "cube.npy", plan(2, 3), model(2, 100, 4))
    assert isinstance(cube.frames, ArrayFrames)
    assert isinstance(cube.frames.array, np.memmap)
    assert np.array_equal(column_commands(cube.plan), [0, 1])
    assert cube.plan.frame_rate == Fraction(97_700)


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


def test_an_archive_is_no_cube(tmp_path: Path) -> None:
    np.savez(tmp_path / "cube.npz", a=np.zeros(3))
    with pytest.raises(UsageError, match="archive"):
        open_cube(tmp_path / "cube.npz", plan(2, 3), model(2, 100, 4))
