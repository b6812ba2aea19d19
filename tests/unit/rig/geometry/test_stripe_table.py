import numpy as np
import pytest

from rig.geometry.stripe_table import depth_errors, stripe_errors

NAN = np.nan


def f32(*rows):
    return np.array(rows, np.float32)


def test_stripe_errors_follow_their_definitions():
    truth = f32([10, 20, 30, 40], [NAN, 60, 70, 80])
    x = f32([10.5, 21, NAN, 44], [5, 60, 70, 78.5])
    # Seven true stripes, errors 0.5 1 - 4 / 0 0 1.5; the answer where no stripe is does not count.
    errors = stripe_errors(x, truth)
    assert errors == pytest.approx(
        {"mean_abs": 7 / 6, "median_abs": 0.75, "within_1px": 4 / 7, "missing": 1 / 7}, abs=1e-12
    )


def test_an_error_of_exactly_one_pixel_is_within_one_pixel():
    errors = stripe_errors(f32([1.0, 3.0]), f32([2.0, 3.0]))
    assert errors["within_1px"] == 1.0
    assert errors["missing"] == 0.0


def test_without_any_true_stripe_there_is_no_figure():
    errors = stripe_errors(f32([1.0, NAN]), f32([NAN, NAN]))
    assert errors == {"mean_abs": None, "median_abs": None, "within_1px": None, "missing": None}


def test_depth_errors_use_the_pixels_that_have_both():
    errors = depth_errors(f32([1.0, 2.5, NAN, 4.0]), f32([1.25, 2.0, 3.0, NAN]))
    assert errors == pytest.approx({"mean_abs": 0.375, "median_abs": 0.375})
    assert depth_errors(f32([NAN]), f32([1.0])) == {"mean_abs": None, "median_abs": None}
