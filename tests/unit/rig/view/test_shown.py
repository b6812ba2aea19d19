"""A map as the page shows it: which pixels, which column under the cursor, which colours, how many points."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rig.run_folder.pictures import CONFIDENCE_SCALE, NO_VALUE, depth_scale, doubt
from rig.view.shown import COLOURS, ShownMap, at_pixels, picture_of, ply_of, points, steady_limits

ROWS, WIDTH, COLUMNS = 6, 20, 10


def a_map() -> ShownMap:
    """Depth 2 m on the left, 4 m on the right, none at the edges; stripes at every other pixel."""
    depth_m = np.full((ROWS, WIDTH), np.nan, np.float32)
    depth_m[:, 2:10], depth_m[:, 10:18] = 2.0, 4.0
    confidence = np.where(np.isfinite(depth_m), 0.9, 0).astype(np.float32)
    confidence[0] *= 0.5
    x_px = np.tile(np.arange(COLUMNS, dtype=np.float32) * 2 + 1, (ROWS, 1))
    sure = np.full((ROWS, COLUMNS), 0.9, np.float32)
    signal = np.tile(np.arange(COLUMNS, dtype=np.float32), (ROWS, 1))
    stripe = {"x_px": x_px, "confidence": sure, "x_sd_px": sure / 9, "signal": signal, "haze": sure / 90}
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, WIDTH), np.linspace(-0.2, 0.2, ROWS))
    counts = np.arange(ROWS * WIDTH, dtype=np.float32).reshape(ROWS, WIDTH)
    rays = u.astype(np.float32), v.astype(np.float32)
    return ShownMap(3, stripe, depth_m, confidence, confidence / 100, counts, None, rays, {"min_confidence": 0.5})


def test_the_column_under_the_cursor_is_that_of_the_nearest_stripe_that_makes_depth() -> None:
    shown = a_map()
    assert [shown.column_at(2, x) for x in (0, 1, 4, 19)] == [0, 0, 1, 9]
    unsure = dict(shown.stripe)
    unsure["confidence"] = shown.stripe["confidence"].copy()
    unsure["confidence"][2, 5] = 0.1
    shown = replace(shown, stripe=unsure)
    assert shown.column_at(2, 11) in (4, 6), "the unsure one is nearest, sure ones are near"
    unsure["confidence"][2] = 0.1
    assert shown.column_at(2, 11) == 5, "none is sure"
    assert shown.column_at(-1, 0) is None
    assert shown.column_at(ROWS, 0) is None
    assert replace(shown, stripe={}).column_at(0, 0) is None
    nothing = {**unsure, "x_px": np.full((ROWS, COLUMNS), np.nan, np.float32)}
    assert replace(shown, stripe=nothing).column_at(0, 0) is None


def test_a_pixel_is_told_with_all_that_is_known_of_it_and_none_for_the_rest() -> None:
    shown = a_map()
    found = shown.pixel(1, 5)
    assert found == {
        "depth_m": 2.0, "depth_sd_m": pytest.approx(0.009), "confidence": pytest.approx(0.9), "counts": 25.0,
    }  # fmt: skip
    assert shown.pixel(1, 0) == {"depth_m": None, "depth_sd_m": pytest.approx(0.0), "confidence": None, "counts": 20.0}
    assert set(shown.pixel(ROWS, WIDTH).values()) == {None}
    assert set(shown.pixel(-1, -1).values()) == {None}


def test_values_of_stripes_go_to_the_pixels_nearest_to_them() -> None:
    shown = a_map()
    assert shown.depth_m is not None
    found = at_pixels(shown.stripe, "signal", shown.depth_m, None)
    assert np.isnan(found[:, [0, 1, 18, 19]]).all()
    for x in range(2, 18):
        nearest = np.abs(shown.stripe["x_px"][1] - x)
        assert nearest[int(found[1, x])] == nearest.min()


def test_points_lie_on_their_rays_in_the_colours_of_the_picture() -> None:
    shown = a_map()
    assert shown.rays is not None
    limits = (1.5, 4.5)
    found = points(shown, "depth", 0.0, 10**6, limits)
    assert found is not None
    assert found.of == len(found.xyz_m) == ROWS * 16
    u, v = (one[np.isfinite(shown.depth_m)] for one in shown.rays)  # type: ignore[arg-type]
    np.testing.assert_allclose(found.xyz_m[:, 0] / found.xyz_m[:, 2], u, rtol=1e-6)
    np.testing.assert_allclose(found.xyz_m[:, 1] / found.xyz_m[:, 2], v, rtol=1e-6)
    assert found.xyz_m.dtype == np.float32
    drawn = picture_of(shown, "depth", 0.0, limits)
    assert drawn is not None
    picture = cv2.imdecode(np.frombuffer(drawn.png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert picture.shape == (ROWS, WIDTH, 3), "each pixel of the picture is one of the map's"
    np.testing.assert_array_equal(picture[np.isfinite(shown.depth_m)], found.rgb)
    assert (picture[np.isnan(shown.depth_m)] == NO_VALUE).all()
    np.testing.assert_array_equal(found.rgb, depth_scale(limits).colours(found.xyz_m[:, 2]))
    assert drawn.legend is not None
    assert drawn.legend.ends == ("1.5", "4.5 m")


def test_a_least_confidence_hides_points_pixels_and_what_is_downloaded() -> None:
    shown = a_map()
    found = points(shown, "depth", 0.8, 10**6, None)
    assert found is not None
    assert found.of == (ROWS - 1) * 16
    drawn = picture_of(shown, "confidence", 0.8, None)
    assert drawn is not None
    picture = cv2.imdecode(np.frombuffer(drawn.png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert (picture[0] == NO_VALUE).all()
    np.testing.assert_array_equal(picture[1, 5], CONFIDENCE_SCALE.colours(doubt(np.array([0.9], np.float32)))[0])
    ply = ply_of(shown, 0.8)
    assert ply is not None
    assert f"element vertex {found.of}\n".encode() in ply
    assert points(shown, "depth", 0.99, 10**6, None) is None
    assert picture_of(shown, "depth", 0.99, None) is None


@pytest.mark.parametrize("by", COLOURS)
def test_points_are_thinned_evenly_whatever_their_colour(by: str) -> None:
    found = points(a_map(), by, 0.0, 40, (1.0, 5.0))
    assert found is not None
    assert 30 <= len(found.xyz_m) <= 40
    assert found.rgb.shape == found.xyz_m.shape
    assert found.of == ROWS * 16
    assert found.legend is not None
    assert len(np.unique(found.legend.rgb, axis=0)) > 8


def test_without_values_for_colours_points_are_grey_and_without_depth_or_rays_there_are_none() -> None:
    shown = a_map()
    grey = points(replace(shown, counts=None), "counts", 0.0, 10**6, None)
    assert grey is not None
    assert grey.legend is None
    assert (grey.rgb == 128).all()
    for less in (replace(shown, rays=None), replace(shown, depth_m=None)):
        assert points(less, "depth", 0.0, 10**6, None) is None
        assert ply_of(less, 0.0) is None
    assert picture_of(replace(shown, depth_m=None), "depth", 0.0, None) is None
    assert picture_of(replace(shown, counts=None), "counts", 0.0, None) is None
    kept = replace(shown, picture_of_counts=b"as the run wrote it")
    drawn = picture_of(kept, "counts", 0.0, None)
    assert drawn is not None
    assert drawn.png == b"as the run wrote it"


def test_colours_of_depth_stay_while_they_suit_and_change_with_the_scene() -> None:
    shown = a_map()
    assert shown.depth_m is not None
    first = steady_limits(None, shown.depth_m)
    assert first is not None
    assert steady_limits(first, shown.depth_m * np.float32(1.05)) == first
    assert steady_limits(first, np.full_like(shown.depth_m, np.nan)) == first
    other = steady_limits(first, shown.depth_m * np.float32(2))
    assert other != first
    assert steady_limits(None, None) is None
