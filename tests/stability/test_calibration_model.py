"""Whatever a model may hold and whatever is seen: calibration is finite numbers or a refusal, never a warning."""

from dataclasses import replace

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from calibration import depth_error
from calibration.board.board import Board, load_board
from calibration.board.detect import find_corners
from calibration.camera_fit import fit_camera
from calibration.depth_error import command_at, depth_jacobian, depth_sd_m, depth_uncertainty, explained
from calibration.errors import CalibrationError, Degenerate
from calibration.model.camera import Camera
from calibration.model.light_sheet import NEARLY_PARALLEL, LightSheets, fan_origin, light_sheets
from calibration.model.parameters import changed_camera, parameters, with_parameters
from calibration.model.rig_model import Covariance, Lag, RigModel
from calibration.model.scanner import PivotScanner, PlaneTable
from calibration.passages.find import SweepCounts, find_passages, flux_picture
from calibration.rig_fit.fit import fit_rig
from calibration.views import Corners, Passages, View
from tests.stability.inventory import EXAMPLES, covers

ANY = st.floats(allow_nan=False, allow_infinity=False)
METRES = st.floats(-1e3, 1e3)
CAMERA = Camera(64, 48, np.array([[70.0, 0, 31.5], [0, 70, 23.5], [0, 0, 1]]), np.array([-0.2, 0.05, 1e-3, 1e-3, 0]))


def mirror(**changes) -> PivotScanner:
    given_ = {
        "axis_point_m": np.array([-0.3, 0.01, 0.02]),
        "axis_direction": np.array([0, 1.0, 0]),
        "zero_normal": np.array([1.0, 0, 0]),
        "angle_rad": np.array([0.1, 0.4]),
    }
    return PivotScanner(**given_ | changes)


@covers(light_sheets, LightSheets, fan_origin, PivotScanner.turned)
@EXAMPLES
@given(
    point=st.tuples(METRES, METRES, METRES), axis=st.tuples(ANY, ANY, ANY), normal=st.tuples(ANY, ANY, ANY),
    angle=st.lists(st.floats(-3, 3), min_size=1, max_size=3), offset=st.lists(st.floats(-20, 20), max_size=3),
    cone=st.floats(-0.6, 0.6), bow=st.floats(-0.6, 0.6), u=ANY | st.floats(-2, 2), v=ANY | st.floats(-2, 2),
    source=st.none() | st.tuples(METRES, METRES, METRES),
)  # fmt: skip
def test_bowed_sheets_of_any_numbers_give_depth_or_none(
    point, axis, normal, angle, offset, cone, bow, u, v, source
) -> None:
    try:
        scanner = PivotScanner(
            *(np.array(a) for a in (point, axis, normal, angle)), (-1.0, 1.0), np.array(offset), cone, bow
        )
    except CalibrationError:
        return
    sheets = light_sheets(scanner, source, np.linspace(-1, 1, 5))
    assert np.isfinite(fan_origin(scanner, source)).all()
    assert np.abs(np.linalg.norm(sheets.planes[:, :3], axis=1) - 1).max() < 1e-12
    z, w = sheets.depth(u, v), sheets.inverse_depth(u, v)
    assert not np.isinf(w).any()
    met = np.isfinite(z)
    assert np.all(z[met] > 0)
    assert np.all(z[met] <= 1.0001 * np.abs(sheets.planes[met, 3]) / NEARLY_PARALLEL)
    points = np.stack([u * z, v * z, z], axis=-1)
    size = np.abs(points).max(axis=-1) + np.abs(sheets.planes[:, 3]) + np.abs(sheets.origin_m).max()
    assert np.all(np.abs(sheets.distance_m(points))[met] <= 1e-9 * size[met])


@covers(RigModel.sheets, RigModel.mirror_command)
@EXAMPLES
@given(lag=st.floats(0, 1), delay=st.floats(-1e-3, 1e-3), row=st.floats(0, 1e4), velocity=st.floats(-1e5, 1e5))
def test_the_mirror_is_behind_by_lag_and_row(lag, delay, row, velocity) -> None:
    model = RigModel(CAMERA, mirror(), Lag(lag, 2 * lag), row_delay_s=delay)
    behind_s = (lag if velocity >= 0 else 2 * lag) - delay * row
    assert np.isclose(model.mirror_command(0.5, row, velocity), 0.5 - velocity * behind_s, rtol=1e-12)
    assert np.array_equal(model.sheets([0.1, 0.2]).planes, model.planes([0.1, 0.2]))


@covers(parameters, with_parameters, changed_camera)
@EXAMPLES
@given(changes=st.dictionaries(st.sampled_from(["fx", "k1", "axis_turn_1", "axis_turn_2", "axis_shift_2", "angle_1",
       "angle_3", "offset_0", "cone", "bow", "lag_forward", "row_delay"]), ANY | st.floats(-0.1, 0.1)))  # fmt: skip
def test_changed_models_are_models_or_refused(changes) -> None:
    base = RigModel(CAMERA, mirror(), Lag(1e-4, 1e-4))
    try:
        changed = with_parameters(base, list(changes), list(changes.values()))
    except CalibrationError:
        return
    names, values = parameters(changed)
    assert len(names) == len(values)
    assert np.isfinite(values).all()
    assert np.abs(np.linalg.norm(changed.planes([-1, 0, 1])[:, :3], axis=1) - 1).max() < 1e-12


@covers(depth_error, Covariance.of)
@EXAMPLES
@given(
    seed=st.integers(0, 10**6), scale=st.sampled_from([0.0, 1e-12, 1e-3, 1e3]), depth_m=st.floats(1e-3, 1e4),
    rank=st.integers(1, 5), command=st.floats(-1, 1), velocity=st.floats(-1e3, 1e3), table=st.booleans(),
)  # fmt: skip
def test_depth_errors_are_numbers_or_none(seed, scale, depth_m, rank, command, velocity, table) -> None:
    rng = np.random.default_rng(seed)
    scanner = mirror(bow_per_rad=rng.choice([0.0, 0.01]), cone_rad=0.01)
    small = Camera(12, 9, np.array([[13.0, 0, 5.5], [0, 13, 4], [0, 0, 1]]), np.zeros(0))
    base = RigModel(small, scanner, Lag(0.0, 1e-4), speed_range_per_s=(1.0, 100.0))
    if table:
        base = replace(base, scanner=PlaneTable(np.linspace(-1, 1, 9), scanner.planes(np.linspace(-1, 1, 9))))
    names = tuple(rng.choice(parameters(base)[0], 5, replace=False).tolist())
    spread = scale * rng.normal(size=(len(names), rank))  # of less than full rank
    known = replace(base, covariance=Covariance(names, spread @ spread.T))
    x, y = rng.uniform(0, 11, 7), rng.uniform(0, 8, 7)
    at = command_at(known, x, y, depth_m)
    assert np.all(np.isnan(at) | (np.abs(at) <= 1 + 1e-12))
    for where in (at, command):
        sd = depth_sd_m(known, x, y, where, velocity)
        assert np.all(np.isnan(sd) | ((sd >= 0) & np.isfinite(sd)))
        jacobian = depth_jacobian(known, x, y, where, velocity)
        part = explained(jacobian, known.covariance, list(names[:2]))
        assert np.all(np.isnan(part) | (part <= sd**2 * (1 + 1e-6) + 1e-300))
    found = depth_uncertainty(known, depth_m)
    assume(np.isfinite(found.sd_m).any())
    assert found.line().startswith(f"at {depth_m:g} m: ")


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
    assert np.isfinite(rig.model.covariance.matrix).all()
