"""Colours that the colour-blind and a grey print keep apart, scales in metres, and counts stretched in fog."""

import cv2
import numpy as np
import pytest

from rig.run_folder.pictures import (
    CONFIDENCE_SCALE,
    NO_VALUE,
    SCALE_PX,
    Scale,
    confidence_picture,
    depth_limits,
    depth_picture,
    depth_scale,
    doubt,
    intensity_picture,
    png_bytes,
    round_values,
)

SCALES = {
    "depth": depth_scale((1.0, 9.0)),
    "confidence": CONFIDENCE_SCALE,
    "error": Scale(20.0, 0.0, "mm", "inferno"),
    "dark rate": Scale(1e5, 10.0, "/s", "inferno", log=True),
}
# What is seen without the cones for long, middle and short waves: Vienot, Brettel and Mollon (1999) for the first two,
# in linear RGB; the third is the confusion of blue with green.
_BLIND = {
    "protan": np.array([[0.1124, 0.8876, 0.0], [0.1124, 0.8876, 0.0], [0.0040, -0.0040, 1.0]]),
    "deutan": np.array([[0.2928, 0.7072, 0.0], [0.2928, 0.7072, 0.0], [-0.0223, 0.0223, 1.0]]),
    "grey print": np.array([[0.2126, 0.7152, 0.0722]] * 3),
}


def linear(rgb):
    """sRGB, uint8, as linear RGB."""
    c = np.asarray(rgb) / 255
    return np.where(c > 0.04045, ((c + 0.055) / 1.055) ** 2.4, c / 12.92)


NORMAL = np.eye(3)


def lightness(rgb, seen_by=NORMAL):
    """CIE L* of sRGB colours (n, 3), 0 to 100."""
    y = np.clip(linear(rgb) @ seen_by.T, 0, 1) @ [0.2126, 0.7152, 0.0722]
    return np.where(y > 0.008856, 116 * np.cbrt(y) - 16, 903.3 * y)


def values_along(scale, n=64):
    """n values from the dark end of a scale to the bright one."""
    if scale.log:
        return np.geomspace(scale.dark, scale.bright, n)
    return np.linspace(scale.dark, scale.bright, n)


@pytest.mark.parametrize("name", SCALES)
@pytest.mark.parametrize("eyes", ["normal", *_BLIND])
def test_lightness_rises_evenly_along_a_scale_whoever_looks(name, eyes):
    seen = lightness(SCALES[name].colours(values_along(SCALES[name])), _BLIND.get(eyes, NORMAL))
    steps = np.diff(seen)
    assert np.all(steps > 0)
    assert steps.max() < 4 * steps.mean()
    assert seen[-1] - seen[0] > 55


@pytest.mark.parametrize("name", SCALES)
@pytest.mark.parametrize("eyes", ["normal", *_BLIND])
def test_no_value_is_darker_than_any_colour_of_a_scale_also_in_print(name, eyes):
    scale, matrix = SCALES[name], _BLIND.get(eyes, NORMAL)
    missing = scale.colours(np.array([np.nan]))
    assert tuple(missing[0]) == NO_VALUE
    assert lightness(scale.colours(values_along(scale)), matrix).min() > lightness(missing, matrix)[0] + 20


def test_what_lies_beyond_the_ends_has_the_colour_of_the_end():
    scale = SCALES["depth"]
    near, far = scale.colours(np.array([0.2, 1.0])), scale.colours(np.array([9.0, 500.0]))
    np.testing.assert_array_equal(near[0], near[1])
    np.testing.assert_array_equal(far[0], far[1])
    assert lightness(near)[0] > lightness(far)[0] + 50


def test_the_scale_beside_a_picture_has_its_colours_its_labels_and_a_sample_of_no_value():
    depth = np.full((240, 50), np.nan, np.float32)
    picture = depth_picture(depth, (1.0, 9.0))
    assert picture.shape == (240, 50 + SCALE_PX, 3)
    assert not picture[:, :50].any()
    bar = picture[:, 50 + 12]
    known = {tuple(colour) for colour in depth_scale((1.0, 9.0)).colours(np.linspace(1, 9, 4000))}
    coloured = [y for y in range(240) if tuple(bar[y]) in known]
    assert coloured == list(range(coloured[0], coloured[-1] + 1))
    assert len(coloured) > 150
    assert np.all(np.diff(lightness(bar[coloured])) <= 0.05)
    black = [y for y in range(240) if tuple(bar[y]) == NO_VALUE]
    assert min(black) > max(coloured)
    ink = (picture[:, 50 + 30 :].max(axis=2) < 150).any(axis=1)
    assert np.count_nonzero(np.diff(np.r_[False, ink].astype(int)) == 1) >= 5  # lines of text
    # A larger range has other labels on the same colours.
    assert not np.array_equal(picture[:, 50:], depth_picture(depth, (1.0, 90.0))[:, 50:])


@pytest.mark.parametrize("rows", [1, 2, 8, 40])
def test_pictures_of_a_few_rows_can_be_drawn(rows):
    depth = np.linspace(1, 3, rows * 12, dtype=np.float32).reshape(rows, 12)
    assert depth_picture(depth, depth_limits(depth)).shape == (rows, 12 + SCALE_PX, 3)
    assert confidence_picture(np.full((rows, 12), 0.7, np.float32)).shape == (rows, 12 + SCALE_PX, 3)
    assert intensity_picture(np.ones((rows, 12), np.uint32)).shape == (rows, 12)


def test_without_limits_a_picture_of_depth_is_black():
    assert depth_limits(np.full((4, 5), np.nan, np.float32)) is None
    assert not depth_picture(np.full((4, 5), np.nan, np.float32), None).any()


def test_confidence_close_to_one_is_spread_and_none_is_black():
    confidence = np.array([[0.0, np.nan, 0.5, 0.9, 0.99, 0.999, 1.0]], np.float32)
    colours = confidence_picture(confidence)[0, :7]
    assert not colours[:2].any()
    seen = lightness(colours)
    assert np.all(np.diff(seen[2:6]) > 8)
    np.testing.assert_array_equal(colours[5], colours[6])
    np.testing.assert_array_equal(np.isnan(doubt(confidence)), [[True, True, *[False] * 5]])


def test_a_picture_comes_back_from_its_png_in_its_colours():
    picture = SCALES["depth"].colours(np.linspace(1, 9, 60).reshape(5, 12))
    read = cv2.imdecode(np.frombuffer(png_bytes(picture), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(read[..., ::-1], picture)


def through_fog(rng, contrast=0.08, veil=400.0):
    """Counts of a disc, a little brighter than its ground, under a veil that falls to the right; and the disc."""
    y, x = np.mgrid[:256, :320]
    disc = (y - 120) ** 2 + (x - 90) ** 2 < 40**2
    light = veil * np.exp(-x / 120) * (1 + contrast * disc)
    counts = rng.poisson(light).astype(np.uint32)
    counts[::37, ::41] = 60_000  # hot pixels
    return counts, disc, (y - 120) ** 2 + (x - 90) ** 2 < 60**2


def test_an_object_stands_out_from_fog_and_hot_pixels_do_not_darken_the_rest():
    counts, disc, near = through_fog(np.random.default_rng(3))
    picture = intensity_picture(counts).astype(float)
    rest = near & ~disc

    def stands_out(level):
        return (np.median(level[disc]) - np.median(level[rest])) / 255

    whole = np.sqrt(np.clip(counts / np.quantile(counts, 0.999), 0, 1)) * 255
    assert stands_out(picture) > 0.15
    assert stands_out(picture) > 2 * stands_out(whole)
    # Most of the grey levels are in use, although one pixel in 1500 is hot.
    assert np.subtract(*np.percentile(picture, [95, 5])) > 120


@pytest.mark.parametrize("level", [0, 7])
def test_a_picture_of_equal_counts_is_flat(level):
    picture = intensity_picture(np.full((30, 70), level, np.uint32))
    assert np.ptp(picture) == 0


def test_steps_where_windows_end_are_not_seen():
    rng = np.random.default_rng(4)
    counts = rng.poisson(200.0, (128, 256))
    counts[:, 128:] += 150
    picture = intensity_picture(counts.astype(np.uint32)).astype(float)
    assert abs(picture[:, 100:124].mean() - picture[:, 132:156].mean()) < 12


@pytest.mark.parametrize(("low", "high", "most"), [(0.0, 1.0, 5), (1.3, 7.9, 6), (-20.0, 20.0, 6), (0.001, 0.0042, 3)])
def test_round_values_are_few_and_within(low, high, most):
    values = round_values(low, high, most)
    assert 1 <= len(values) <= most + 1
    assert low <= values[0] <= values[-1] <= high
