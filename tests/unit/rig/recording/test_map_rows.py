"""Counts of single rows of a recorded map, against the counts of a replay and the bits on the disk."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.recorded import RunRecording
from rig import api
from rig.count.sweeps import SweepData
from rig.count.volume import CountVolume
from rig.errors import UsageError
from rig.recording.map_rows import MapRows
from rig.recording.replay import replay_config
from rig.requests import ReplayRequest
from rig.run_folder.summary import MapTally
from rig.scan.monitor import Listeners
from rig.scan.replay import play
from rig.scan.run import Run
from tests.system.small_rig import HEIGHT, WIDTH, config, write_rig

ROWS = (0, 17, HEIGHT - 1)


def two_lines(folder: Path) -> Path:
    content: dict[str, Any] = config()
    content["scan"] |= {"command_range": [-0.4, 0.4], "bidirectional": True, "depth_range": ["2 m", "15 m"]}
    content |= {"line_offsets": [-0.4, 0.4], "line_power": "each"}
    return write_rig(folder, content)


def windows_that_move(folder: Path) -> Path:
    """A rig whose link carries no full frames."""
    content: dict[str, Any] = config()
    content["scan"] |= {"depth_range": ["2 m", "15 m"]}
    content["spad"] |= {"link": "100 MB/s"}
    return write_rig(folder, content, width=320)


def recorded(folder: Path, file: Path, **changes: Any) -> Path:
    api.scan(file, maps=3, out=folder / "run", record=True, **changes)
    return folder / "run"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rows")
    return recorded(folder, write_rig(folder / "rig"))


def volumes(run: Path) -> list[CountVolume]:
    """The counts that a replay hands to its estimator, map by map."""
    seen: list[SweepData] = []
    request = ReplayRequest(clock="max", estimator="argmax")
    settings = replay_config(run, request)
    with Run(None, MapTally(0, 0, "argmax", "none")) as target:
        play(settings, run, target, request, Listeners(sweeps=seen.append), None)
    assert all(isinstance(sweep.tally, CountVolume) for sweep in seen)
    return [sweep.tally for sweep in seen if isinstance(sweep.tally, CountVolume)]


def test_a_row_has_the_counts_and_frames_of_a_replay_in_every_column(run: Path) -> None:
    rows = MapRows(run)
    assert rows.maps == [0, 1, 2]
    for number, volume in reversed([*enumerate(volumes(run))]):
        for row in ROWS:
            found = rows.row(number, row)
            assert found.counts.shape == (200, WIDTH)
            np.testing.assert_array_equal(found.frames, volume.n_frames)
            for column, first in enumerate(volume.x0.tolist()):
                whole = np.pad(found.counts[column], (0, volume.counts.shape[2]))
                np.testing.assert_array_equal(
                    whole[first : first + volume.counts.shape[2]],
                    volume.counts[column, row],
                    f"{number} {row} {column}",
                )


def test_a_row_has_the_bits_of_the_maps_lit_frames_on_the_disk(run: Path) -> None:
    rows, recording = MapRows(run), RunRecording(run)
    sweep = json.loads((run / "manifest.json").read_text())["sweeps"][1]
    blocks = recording.blocks(recording.runs[0], sweep["first_frame"], sweep["end_frame"])
    bits = np.concatenate([np.unpackbits(block.bits, axis=2)[:, :, :WIDTH] for block in blocks])
    lit = np.zeros(len(bits), bool)
    at = 0
    for _, bins, _ in rows.frames(1).pieces:
        lit[at : at + len(bins)] = bins >= 0
        at += len(bins)
    assert at == len(bits)
    assert lit.sum() == rows.frames(1).n_frames.sum() > 0
    np.testing.assert_array_equal(rows.summed(1), bits[lit].sum(axis=0))
    for row in ROWS:
        np.testing.assert_array_equal(rows.row(1, row).counts.sum(axis=0), bits[lit, row].sum(axis=0))


def test_windows_are_those_in_which_the_stripe_is_searched(run: Path) -> None:
    rows = MapRows(run)
    found = rows.row(0, 17)
    geometry = rows.geometry
    seen = geometry.x_lo[17] <= geometry.x_hi[17]
    np.testing.assert_array_equal(found.begin_px[seen], geometry.x_lo[17][seen])
    np.testing.assert_array_equal(found.end_px[seen], geometry.x_hi[17][seen] + 1)
    assert seen.any()
    assert not found.end_px[~seen].any()


@pytest.mark.parametrize("rig", [two_lines, windows_that_move])
def test_rows_of_two_lines_and_of_windows_that_move_have_the_counts_of_a_replay(
    rig: Callable[[Path], Path], tmp_path: Path
) -> None:
    run = recorded(tmp_path, rig(tmp_path / "rig"))
    volume, rows = volumes(run)[2], MapRows(run)
    found = rows.row(2, 9)
    np.testing.assert_array_equal(found.frames, volume.n_frames)
    for column, first in enumerate(volume.x0.tolist()):
        end = min(first + volume.counts.shape[2], rows.plan.width)
        np.testing.assert_array_equal(found.counts[column, first:end], volume.counts[column, 9, : end - first])
    np.testing.assert_array_equal(found.counts.sum(axis=0), rows.summed(2)[9] * (2 if rows.plan.lines else 1))


def test_without_an_account_of_the_sweeps_a_map_is_found_by_playing_from_the_start(run: Path, tmp_path: Path) -> None:
    part = tmp_path / "part"
    api.cut(run, part, maps="1:3")
    np.testing.assert_array_equal(MapRows(part).row(1, 17).counts, MapRows(run).row(2, 17).counts)
    rows = MapRows(run)
    rows._sweeps = []
    np.testing.assert_array_equal(rows.row(2, 17).counts, MapRows(run).row(2, 17).counts)


def test_a_map_or_row_that_is_not_there_is_named(run: Path) -> None:
    rows = MapRows(run)
    with pytest.raises(UsageError, match=r"map 3 is not in .*run; it has 0 to 2"):
        rows.row(3, 0)
    with pytest.raises(UsageError, match=f"row {HEIGHT} is not in the picture, which has {HEIGHT}"):
        rows.row(0, HEIGHT)
