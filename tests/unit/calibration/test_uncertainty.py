"""How well depth is known, against models drawn from the covariance."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.depth_error import (
    GROUPS,
    command_at,
    depth_jacobian,
    depth_sd_m,
    depth_uncertainty,
    explained,
    group_of,
)
from calibration.errors import CalibrationError
from calibration.model.parameters import parameters, with_parameters
from calibration.model.rig_model import Covariance, Lag, RigModel
from calibration.model.scanner import PivotScanner
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
    assert base.covariance is not None
    y, x = (a.ravel().astype(float) for a in np.mgrid[30:512:110, 40:512:110])
    command = command_at(base, x, y, 5.0)
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
    predicted = np.stack([depth_sd_m(base, x, y, command, float(each)) for each in velocity[:, 0]])
    ratio = np.std(drawn, axis=0) / predicted
    assert np.abs(ratio - 1).max() < 0.02  # what is left bends


@pytest.mark.parametrize("depth_m", [0.8, 2.0, 20.0])
def test_the_command_found_lights_the_pixel_at_that_depth(depth_m: float) -> None:
    base = model()
    x, y = np.arange(0.0, 512, 37), np.arange(0.0, 512, 41)[:, None]
    command = command_at(base, x, y, depth_m)
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
    found = depth_uncertainty(base, 5.0)
    dark = np.isnan(found.sd_m)
    assert 0.1 < dark.mean() < 0.9
    for part in found.part_m.values():
        assert np.array_equal(np.isnan(part), dark)
    assert np.isnan(depth_sd_m(base, [10.0], [np.nan], [0.0])).all()
    with pytest.raises(CalibrationError, match="no covariance"):
        depth_uncertainty(model(known=False), 3.0)
    assert depth_uncertainty(base, 0.01).line() == "at 0.01 m: not lit"


def test_parts_are_what_would_go_if_a_group_were_known() -> None:
    base = model()
    covariance = base.covariance
    assert covariance is not None
    x, y = np.array([100.0, 400.0]), np.array([200.0, 300.0])
    jacobian = depth_jacobian(base, x, y, command_at(base, x, y, 5.0), 50.0)
    whole = depth_sd_m(base, x, y, command_at(base, x, y, 5.0), 50.0) ** 2
    for group in GROUPS:
        names = [name for name in covariance.names if group_of(name) == group]
        part = explained(jacobian, covariance, names)
        rest = [i for i, name in enumerate(covariance.names) if name not in names]
        # The covariance of the others once these are known, by the inverse of their block of the information.
        left = np.linalg.inv(np.linalg.inv(covariance.matrix)[np.ix_(rest, rest)])
        assert whole - part == pytest.approx(np.einsum("ni,ij,nj->n", jacobian[:, rest], left, jacobian[:, rest]))
    assert explained(jacobian, covariance, list(covariance.names)) == pytest.approx(whole)


def test_one_line_says_how_well_depth_is_known_and_what_from() -> None:
    base = model()
    only = Covariance(("axis_shift_1", "fx", "lag_forward"), np.diag([3e-4, 1e-3, 1e-9]) ** 2)
    found = depth_uncertainty(replace(base, covariance=only), 5.0)
    share = np.nanmedian(found.sd_m) * 1e3
    assert (
        found.line()
        == f"at 5 m: {share:.2g} mm, {np.nanmedian(found.part_m['baseline']) * 1e3:.2g} of them from the baseline"
    )
    # A relative error of the baseline of 1e-3 is one of the depth: 5 mm, but for the tilt of the planes.
    assert 4.5 < share < 6
    exact = Covariance(("fx",), np.zeros((1, 1)))
    assert depth_uncertainty(replace(base, covariance=exact), 5.0).line().startswith("at 5 m: 0 mm, 0 of them from")
    slow = depth_uncertainty(replace(base, covariance=only), 5.0, 0.0)
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
