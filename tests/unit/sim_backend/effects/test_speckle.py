"""Speckle: mean 1, the contrast of Goodman's formula, and grains that stay."""

from dataclasses import replace

import numpy as np
import pytest

from sim_backend.effects import speckle
from sim_backend.effects.speckle import Speckle, gamma_of, grains
from sim_backend.effects.stripe import Stripe
from sim_backend.light.line import ONE_LINE
from sim_backend.light.optics import Line, Optics, Sensor
from sim_backend.random_numbers import frame_key
from tests.stability.inventory import covers
from tests.unit.sim_backend.rigs import Array, rig, setting, wall

covers(speckle)


@pytest.mark.parametrize("shape", [1.0, 43.0])
def test_a_pixels_light_is_gamma_distributed(shape: float) -> None:
    drawn = np.array([gamma_of(np.uint64(frame_key(np.uint64(5), np.uint64(i))), shape) for i in range(40_000)])
    assert drawn.mean() == pytest.approx(1, abs=5 / np.sqrt(shape * len(drawn)))
    assert drawn.std() == pytest.approx(1 / np.sqrt(shape), rel=0.03)
    third = np.mean((drawn - 1) ** 3) / drawn.std() ** 3
    assert third == pytest.approx(2 / np.sqrt(shape), rel=0.15, abs=0.05)


def test_the_contrast_is_that_of_the_grains_in_a_diode() -> None:
    """Diode 5.3 um wide, grains 1.2 um wide: 20 of them and one, of two polarisations."""
    assert grains(Optics(), Sensor(), Line()) == pytest.approx(2 * (1 + 28.17 / 1.377), rel=1e-3)
    one_grain = grains(Optics(f_number=200.0), Sensor(), Line())
    assert one_grain == pytest.approx(2, rel=0.01)


def _light(command: float, first: int = 0, last: int = 64) -> tuple[Array, Array]:
    model = rig()
    setup = setting(model, wall(model, (0.0, 0.0, 1.0), 2.0), line=Line(speckle=True))
    sheet, smooth = setup.view.sheet(model.planes(command)), np.zeros((64, 96))
    Stripe(setup).add(sheet, first, last, smooth)
    rough = smooth.copy()
    Speckle(setup).add(sheet, first, last, rough)
    return smooth, rough


def test_it_stays_for_a_column_and_is_another_one_in_the_next() -> None:
    smooth, rough = _light(0.1)
    lit = smooth > 0
    ratio = rough[lit] / smooth[lit]
    assert ratio.std() == pytest.approx(1 / np.sqrt(42.9), rel=0.15)
    assert ratio.mean() == pytest.approx(1, abs=0.03)
    assert np.array_equal(rough, _light(0.1)[1])
    assert np.array_equal(rough == 0, ~lit)
    nearly = _light(0.1001)  # a thousandth of a pixel on
    assert nearly[1][lit] / nearly[0][lit] == pytest.approx(ratio)
    top, bottom = _light(0.1, 0, 20)[1], _light(0.1, 20, 64)[1]
    assert np.array_equal(rough, top + bottom)
    other_smooth, other = _light(0.13)
    both = lit & (other_smooth > 0)
    correlation = np.corrcoef(rough[both] / smooth[both], other[both] / other_smooth[both])[0, 1]
    assert abs(correlation) < 5 / np.sqrt(both.sum())


def test_on_a_bowed_sheet_it_is_the_same_whichever_rows_are_drawn_first() -> None:
    model = rig()
    model = replace(model, scanner=replace(model.scanner, bow_per_rad=0.1))
    setup = setting(model, wall(model, (0.3, -0.2, 1.0), 2.0), line=Line(speckle=True))

    def drawn(bands: tuple[tuple[int, int], ...]) -> Array:
        ((sheet,),) = ONE_LINE.sheets(model.sheets, np.array([0.1]), setup.view.rows, [0.0])
        rate = np.ones((64, 96))
        for band in bands:
            setup.view.trace(sheet, *band)
            Speckle(setup).add(sheet, *band, rate)
        return rate

    assert np.array_equal(drawn(((0, 20), (20, 64))), drawn(((20, 64), (0, 20))))
