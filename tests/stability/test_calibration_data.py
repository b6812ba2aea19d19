"""Whatever is counted and seen, a calibration is finite numbers or a refusal; never NaN, infinity or a warning."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from calibration.board.board import Board, load_board
from calibration.board.detect import find_corners
from calibration.camera_fit import fit_camera
from calibration.errors import CalibrationError, Degenerate
from calibration.passages.find import SweepCounts, find_passages, flux_picture
from calibration.rig_fit.fit import fit_rig
from calibration.views import Corners, Passages, View
from tests.stability.inventory import EXAMPLES, covers

SIZE = 96, 64
BOARD: Board = load_board()
SEEDS = st.integers(0, 2**32 - 1)


@st.composite
def sweeps(draw: st.DrawFn) -> SweepCounts:
    """Counts of any brightness, from none to all frames lit, with columns that no frame fell into."""
    rng = np.random.default_rng(draw(SEEDS))
    columns, rows, width = draw(st.integers(1, 40)), draw(st.integers(1, 6)), 64
    most = draw(st.sampled_from([1, 3, 10, 255, 300]))
    n_frames = rng.integers(0, most + 1, columns)
    n_frames[rng.random(columns) < draw(st.sampled_from([0.0, 0.3, 1.0]))] = 0
    lit = draw(st.sampled_from([0.0, 1e-3, 0.5, 1.0]))
    chance = np.full((columns, rows, width), lit)
    if draw(st.booleans()):  # a line among them
        at = np.arange(columns)[:, None, None] - np.linspace(0, columns, width)[None, None, :]
        chance = np.maximum(chance, np.exp(-(at**2)))
    counts = rng.binomial(n_frames[:, None, None], chance).astype(np.uint8 if most < 256 else np.uint16)
    command = np.where(n_frames > 0, np.linspace(-0.8, 0.8, columns), np.nan)
    return SweepCounts(counts, n_frames, command, np.zeros(columns, np.int32), width)


@covers(find_passages, flux_picture)
@EXAMPLES
@given(sweeps(), st.sampled_from([1, -1]))
def test_passages_and_pictures_of_any_counts(sweep: SweepCounts, direction: int) -> None:
    found = find_passages(sweep, direction, 3.0)
    for values in (found.x_px, found.y_px, found.command, found.sd):
        assert np.isfinite(values).all()
    assert (found.sd > 0).all()
    picture = flux_picture((sweep,))
    assert picture.shape == (sweep.counts.shape[1], sweep.width)
    assert not np.isinf(picture).any()


@covers(find_corners)
@EXAMPLES
@given(SEEDS, st.sampled_from([0.0, 1e-9, 1.0, 1e6]), st.booleans())
def test_pictures_without_a_board(seed: int, scale: float, holes: bool) -> None:
    rng = np.random.default_rng(seed)
    picture = (scale * rng.poisson(2.0, (64, 96))).astype(np.float32)
    if holes:
        picture[rng.random(picture.shape) < 0.2] = np.nan
    try:
        found = find_corners(picture, BOARD)
    except Degenerate:
        return
    assert np.isfinite(found.px).all()


@st.composite
def views(draw: st.DrawFn) -> list[View]:
    """Corners and passages that no rig shows, some of them in one place."""
    rng = np.random.default_rng(draw(SEEDS))
    spread = draw(st.sampled_from([0.0, 1e-6, 1.0, 50.0]))
    shown = []
    for i in range(draw(st.integers(0, 7))):
        ids = np.sort(rng.permutation(len(BOARD.corners_m))[: rng.integers(4, 40)]).astype(np.int32)
        px = np.array(SIZE) / 2 + BOARD.corners_m[ids, :2] * 100 * draw(st.sampled_from([1.0, 0.0])) - 20
        corners = Corners(ids, px + spread * rng.standard_normal((len(ids), 2)))
        n = int(rng.integers(0, 60))
        sweep = Passages(
            rng.uniform(0, SIZE[0], n), rng.uniform(0, SIZE[1], n), rng.uniform(-0.8, 0.8, n), np.full(n, 1e-4), 1, 3.0
        )
        shown.append(View(f"{i}", corners, (sweep,)))
    return shown


@covers(fit_camera, fit_rig)
@EXAMPLES
@given(views())
def test_views_that_no_rig_shows_are_refused_or_fitted_with_finite_numbers(shown: list[View]) -> None:
    try:
        fit = fit_camera(shown, BOARD, SIZE)
    except CalibrationError:
        pass
    else:
        assert np.isfinite(fit.covariance.matrix).all()
        assert np.isfinite(fit.camera.matrix).all()
    try:
        rig = fit_rig(shown, BOARD, SIZE)
    except CalibrationError:
        return
    assert rig.model.covariance is not None
    assert np.isfinite(rig.model.covariance.matrix).all()
