"""How well depth is known, against models drawn from the covariance; parameters do what their names say."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration import depth_error
from calibration.errors import CalibrationError
from calibration.model.parameters import parameters, with_parameters
from calibration.model.rig_model import Covariance, Lag, RigModel
from calibration.model.scanner import PivotScanner, PlaneTable
from tests.unit.calibration.cameras import camera

SD = {"f": 0.3, "c": 0.3, "k": 1e-3, "p": 1e-4, "a": 2e-5, "o": 2e-5, "b": 2e-5, "l": 1e-7, "r": 1e-10}
"""Of parameters, by the first letter of their names."""


def model(known: bool = True) -> RigModel:
    scanner = PivotScanner(
        np.array([-0.3, 0.0, 0.02]), np.array([0.02, 1, -0.01]), np.array([1, 0, 0.0]), np.array([0.1, 0.45, 1e-3]),
        offset_m=np.array([1e-3]), cone_rad=0.004, bow_per_rad=0.01,
    )  # fmt: skip
    bare = RigModel(
        camera([-0.1, 0.02, 0, 0, 0]), scanner, Lag(2e-4, 2e-4), speed_range_per_s=(20.0, 100.0), row_delay_s=1e-8
    )
    return replace(bare, covariance=covariance_of(bare)) if known else bare


def covariance_of(bare: RigModel, correlated: float = 0.4) -> Covariance:
    names, _ = parameters(bare)
    mixed = np.eye(len(names)) + correlated * np.random.default_rng(1).normal(size=(len(names),) * 2)
    matrix = mixed @ mixed.T
    sd = np.array([2e-5 if name == "cone" else SD[name[0]] for name in names]) / np.sqrt(np.diag(matrix))
    return Covariance(names, matrix * np.outer(sd, sd))


def test_the_sd_is_that_of_models_drawn_from_the_covariance() -> None:
    base, rng = model(), np.random.default_rng(7)
    y, x = (a.ravel().astype(float) for a in np.mgrid[30:512:110, 40:512:110])
    command = depth_error.command_at(base, x, y, 5.0)
    spread = np.linalg.cholesky(base.covariance.matrix)
    velocity = np.array([100.0, -100.0, 0.0])[:, None]
    drawn = []
    draws = rng.normal(size=(100, len(spread)))
    draws -= draws.mean(axis=0)
    draws = np.linalg.solve(np.linalg.cholesky(np.cov(draws.T, bias=True)), draws.T).T  # their own covariance: 1
    for draw in draws:
        other = with_parameters(base, base.covariance.names, spread @ draw)
        at = command + other.mirror_command(0, y, velocity) - base.mirror_command(0, y, velocity)
        drawn.append(other.sheets(at).depth(*other.camera.tangents_at(x, y)))
    predicted = np.stack([depth_error.depth_sd_m(base, x, y, command, float(each)) for each in velocity[:, 0]])
    ratio = np.std(drawn, axis=0) / predicted
    assert np.abs(ratio - 1).max() < 0.02  # what is left bends


@pytest.mark.parametrize("depth_m", [0.8, 2.0, 20.0])
def test_the_command_found_lights_the_pixel_at_that_depth(depth_m: float) -> None:
    base = model()
    x, y = np.arange(0.0, 512, 37), np.arange(0.0, 512, 41)[:, None]
    command = depth_error.command_at(base, x, y, depth_m)
    lit = np.isfinite(command)
    assert lit.mean() > 0.3
    u, v = (tangent[lit] for tangent in base.camera.tangents_at(x, y))
    assert base.sheets(command[lit]).depth(u, v) == pytest.approx(np.full(lit.sum(), depth_m), rel=1e-6)
    inside = (command[lit] >= -1) & (command[lit] <= 1)
    assert inside.all()
    # Not lit means that at both ends of the range the light passes on the same side.
    u, v = (tangent[~lit] for tangent in base.camera.tangents_at(x, y))
    points = np.stack([u, v, np.ones_like(u)], -1) * depth_m
    first, last = (base.sheets(np.full(len(u), end)).distance_m(points) for end in (-1.0, 1.0))
    assert np.all(first * last > 0)


def test_what_no_command_lights_is_not_known_and_the_rest_is() -> None:
    narrow = replace(model().scanner, command_range=(-0.2, 0.2))
    base = replace(model(), scanner=narrow)
    found = depth_error.depth_uncertainty(base, 5.0)
    dark = np.isnan(found.sd_m)
    assert 0.1 < dark.mean() < 0.9
    for part in found.part_m.values():
        assert np.array_equal(np.isnan(part), dark)
    assert np.isnan(depth_error.depth_sd_m(base, [10.0], [np.nan], [0.0])).all()
    with pytest.raises(CalibrationError, match="no covariance"):
        depth_error.depth_uncertainty(model(known=False), 3.0)
    assert depth_error.depth_uncertainty(base, 0.01).line() == "at 0.01 m: not lit"


def test_parts_are_what_would_go_if_a_group_were_known() -> None:
    base = model()
    covariance = base.covariance
    x, y = np.array([100.0, 400.0]), np.array([200.0, 300.0])
    jacobian = depth_error.depth_jacobian(base, x, y, depth_error.command_at(base, x, y, 5.0), 50.0)
    whole = depth_error.depth_sd_m(base, x, y, depth_error.command_at(base, x, y, 5.0), 50.0) ** 2
    for group in depth_error.GROUPS:
        names = [name for name in covariance.names if depth_error.group_of(name) == group]
        part = depth_error.explained(jacobian, covariance, names)
        rest = [i for i, name in enumerate(covariance.names) if name not in names]
        # The covariance of the others once these are known, by the inverse of their block of the information.
        left = np.linalg.inv(np.linalg.inv(covariance.matrix)[np.ix_(rest, rest)])
        assert whole - part == pytest.approx(np.einsum("ni,ij,nj->n", jacobian[:, rest], left, jacobian[:, rest]))
    assert depth_error.explained(jacobian, covariance, list(covariance.names)) == pytest.approx(whole)


def test_one_line_says_how_well_depth_is_known_and_what_from() -> None:
    base = model()
    only = Covariance(("axis_shift_1", "fx", "lag_forward"), np.diag([3e-4, 1e-3, 1e-9]) ** 2)
    found = depth_error.depth_uncertainty(replace(base, covariance=only), 5.0)
    share = np.nanmedian(found.sd_m) * 1e3
    assert (
        found.line()
        == f"at 5 m: {share:.2g} mm, {np.nanmedian(found.part_m['baseline']) * 1e3:.2g} of them from the baseline"
    )
    # A relative error of the baseline of 1e-3 is one of the depth: 5 mm, but for the tilt of the planes.
    assert 4.5 < share < 6
    exact = Covariance(("fx",), np.zeros((1, 1)))
    assert (
        depth_error.depth_uncertainty(replace(base, covariance=exact), 5.0)
        .line()
        .startswith("at 5 m: 0 mm, 0 of them from")
    )
    slow = depth_error.depth_uncertainty(replace(base, covariance=only), 5.0, 0.0)
    assert np.nanmax(slow.part_m["lag"]) == 0 < np.nanmax(found.part_m["lag"])


@pytest.mark.parametrize(
    ("names", "matrix", "said"),
    [
        (("fx",), np.eye(2), "shape"),
        (("fx", "fx"), np.eye(2), "twice"),
        (("fx", "fy"), [[1, np.nan], [np.nan, 1]], "finite"),
        (("fx", "fy"), [[1, 0.5], [0.2, 1]], "symmetric"),
        (("fx", "fy"), [[0, 1e-9], [1e-9, 1]], "positive"),
    ],
)
def test_a_covariance_that_is_none_is_refused(names, matrix, said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        Covariance(names, np.array(matrix, float))


COMMANDS = np.linspace(-1, 1, 9)


def bent_model(**changes) -> RigModel:
    scanner = PivotScanner(
        np.array([-0.3, 0.1, 0.02]), np.array([0.02, 1, -0.05]), np.array([1, 0, 0.1]), np.array([0.1, 0.4, 1e-3]),
        offset_m=np.array([1e-3, 2e-4]), cone_rad=0.01, bow_per_rad=0.02,
    )  # fmt: skip
    return RigModel(camera([-0.3, 0.1, 1e-3, 1e-3, 0.01]), scanner, Lag(2e-4, 3e-4), row_delay_s=1e-8, **changes)


def test_every_parameter_is_named_once_with_its_value() -> None:
    names, values = parameters(bent_model())
    assert len(set(names)) == len(names) == len(values)
    assert names[:6] == ("fx", "fy", "cx", "cy", "k1", "k2")
    said = dict(zip(names, values, strict=True))
    assert said["k3"] == 0.01
    assert said["axis_turn_1"] == said["axis_shift_2"] == 0
    assert (said["angle_2"], said["offset_1"], said["cone"], said["bow"]) == (1e-3, 2e-4, 0.01, 0.02)
    assert (said["lag_forward"], said["lag_backward"], said["row_delay"]) == (2e-4, 3e-4, 1e-8)


def test_axis_turns_and_shifts_move_all_planes_as_one_body() -> None:
    base = bent_model()
    mirror = base.scanner
    e1, e2 = mirror.zero_normal, np.cross(mirror.axis_direction, mirror.zero_normal)
    turn = cv2.Rodrigues(0.02 * e1 - 0.03 * e2)[0]
    shift = 0.004 * e1 - 0.002 * e2
    names = ("axis_turn_1", "axis_turn_2", "axis_shift_1", "axis_shift_2")
    moved = with_parameters(base, names, [0.02, -0.03, 0.004, -0.002]).planes(COMMANDS)
    planes = base.planes(COMMANDS)
    normal = planes[:, :3] @ turn.T
    about = planes[:, 3] - planes[:, :3] @ mirror.axis_point_m  # of a plane turned about the axis point, the same
    assert moved[:, :3] == pytest.approx(normal, abs=1e-14)
    assert moved[:, 3] == pytest.approx(about + normal @ (mirror.axis_point_m + shift), abs=1e-14)


def test_terms_beyond_those_of_the_model_begin_at_zero() -> None:
    longer = with_parameters(bent_model(), ["angle_4", "offset_3"], [1e-4, 2e-5]).scanner
    assert longer.angle_rad.tolist() == [0.1, 0.4, 1e-3, 0, 1e-4]
    assert longer.offset_m.tolist() == [1e-3, 2e-4, 0, 2e-5]


def test_what_a_model_does_not_have_is_refused_with_what_it_has() -> None:
    table = RigModel(camera([]), PlaneTable(np.zeros(1), np.array([[1, 0, 0, -0.3]])))
    assert "angle_0" not in parameters(table)[0]
    for name in ("angle_0", "k1", "nonsense"):
        with pytest.raises(CalibrationError, match=f"no parameter {name}; it has fx, fy"):
            with_parameters(table, [name], [0.1])
    with pytest.raises(CalibrationError, match="lag_s"):
        with_parameters(table, ["lag_forward"], [-1.0])
