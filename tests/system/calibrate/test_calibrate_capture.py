"""A capture of the simulated board: picture, corners and passages as the scene has them, live and from a recording."""

import numpy as np
import pytest

from calibration.board.board import load_board
from calibration.files.rig_file import load_rig_model
from drivers.clock import VirtualClock
from drivers.registry import Surroundings
from rig.api import configure
from rig.calibrate.capture import MOST_LAG_S, capture_recorded, capture_view
from rig.calibrate.sync import gate_delay
from rig.config.models import ScanConfig
from rig.errors import PlanError, UsageError
from sim_backend.world import DEFAULT_GEOMETRY, SimulatedWorld

LAG_S = 2e-4
"""Of the simulated mirror, both ways (config/simulated-rig.yaml)."""
RANGE, COLUMNS = (-0.15, 0.7), 200
"""Over the board of config/scenes/board.yaml, a column a pixel."""


def _config(**scan):
    config = configure(scene="board")
    changes = {"columns": COLUMNS, "exposures": 4, "command_range": RANGE} | scan
    content = config.scan.model_dump(mode="json") | changes
    return config.model_copy(update={"scan": ScanConfig.model_validate(content)})


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    run = tmp_path_factory.mktemp("capture") / "run"
    config = _config()
    return config, capture_view(config, "000", load_board(), seed=1, out=run), run


@pytest.mark.long
def test_the_board_is_found_where_it_is(captured):
    _, capture, _ = captured
    assert capture.refused is None
    assert len(capture.view.corners.ids) == 48
    assert capture.view.picture is not None
    assert capture.view.picture.shape == (512, 512)
    white = np.nanpercentile(capture.view.picture, 99)
    assert white == pytest.approx(0.07, rel=0.2)  # 30 lux on white paper, see config/scenes/board.yaml


def _require_true(config, passages, least, share):
    """Passages are where the mirror stands when its line meets what a pixel sees, but for the lag.

    That is so of most of them, share, at least; errors in their sd are returned.
    """
    model = load_rig_model(DEFAULT_GEOMETRY)
    world = SimulatedWorld(config.world, Surroundings(VirtualClock(), None, 0))
    u, _ = model.camera.tangents()
    angle = np.arctan2(u * world.surfaces.depth_m + 0.3, world.surfaces.depth_m)  # of the mirror 0.3 m on the left
    stands = (angle - model.scanner.angle_rad[0]) / model.scanner.angle_rad[1]
    true = stands[passages.y_px.astype(int), passages.x_px.astype(int)]
    error = passages.command - passages.direction * passages.speed_per_s * LAG_S - true
    good = np.abs(error) < 5 * passages.sd
    assert len(error) > least
    assert np.mean(good) > share
    assert abs(np.mean(error[good])) < 0.02 * (RANGE[1] - RANGE[0]) / COLUMNS
    return (error / passages.sd)[good]


def test_passages_are_those_of_the_scene_without_its_lag(captured):
    config, capture, _ = captured
    assert [passages.direction for passages in capture.view.passages] == [1, -1]
    for passages in capture.view.passages:
        error_sds = _require_true(config, passages, least=1000, share=0.99)
        assert 0.7 < np.std(error_sds) < 1.15
        begins = RANGE[0] if passages.direction > 0 else RANGE[1]
        assert np.min(passages.direction * (passages.command - begins)) >= passages.speed_per_s * MOST_LAG_S


@pytest.mark.long
def test_windows_of_a_rough_calibration_leave_its_lag_out():
    config = _config()
    config = config.model_copy(update={"spad": type(config.spad)(link="2.4 GB/s")})
    capture = capture_view(config, "000", None)
    assert np.isnan(capture.view.picture).any()  # where no window came
    for passages in capture.view.passages:
        _require_true(config, passages, least=500, share=0.98)
    with pytest.raises(PlanError, match="the link of the simulated SPAD"):
        capture_view(config.model_copy(update={"calibration": None}), "000", None)


def test_a_recording_gives_the_same_view(captured):
    _, capture, run = captured
    again = capture_recorded(run, "000", load_board())
    assert np.array_equal(again.view.picture, capture.view.picture)
    assert np.array_equal(again.view.corners.px, capture.view.corners.px)
    for one, other in zip(again.view.passages, capture.view.passages, strict=True):
        assert np.array_equal(one.command, other.command)
        assert np.array_equal(one.sd, other.sd)


def test_a_picture_without_a_board_is_kept_with_the_reason():
    config = _config(columns=40, command_range=[0.0, 0.17])
    config = config.model_copy(update={"world": config.world.model_copy(update={"scene": "street"})})
    capture = capture_view(config, "000", load_board())
    assert capture.view.corners is None
    assert capture.view.picture is not None
    assert capture.refused.reason == "no-board"


def test_rigs_of_several_lines_and_real_light_are_refused():
    with pytest.raises(UsageError, match="4 lines"):
        capture_view(configure("simulated-4-lines"), "000", None)
    with pytest.raises(UsageError, match="`arm=True`"):
        capture_view(configure("lab"), "000", None)


def test_the_simulated_gate_has_no_delay(captured):
    delay = gate_delay(captured[2])
    assert delay.edges == 4  # two sweeps
    for late_s, sd_s in ((delay.opens_s, delay.opens_sd_s), (delay.closes_s, delay.closes_sd_s)):
        assert abs(late_s) < 3 * sd_s
        assert sd_s < 4e-6  # the line is so bright that within a frame little is told
    assert abs(delay.delay_s) < 3 * delay.sd_s
