"""The suite of every estimator: its stripe tables keep their promises for any counts, and it finds a clear stripe.

The sweeps are drawn here, without the simulator: a flat, slightly turned wall behind fog, seen by a small rig with the
mirror on its left. Only the counts tell an estimator of that scene.
"""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.model.camera import Camera
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PlaneTable
from rig.count.volume import CountVolume, SweepLayout
from rig.estimate.registry import Estimator
from rig.geometry.stripe_table import StripeTable, stripe_errors
from rig.geometry.windows import SweepGeometry, sweep_geometry

ROWS, WIDTH, COLUMNS = 12, 256, 40
FOCAL_PX = 200.0
BASELINE_M = 0.3
RANGE_M = (1.0, 8.0)
EXPOSURES = 20
SIGNAL, HAZE, DARK = 0.9, 0.04, 0.002
"""Flux of the stripe's brightest pixel, of the fog nearest to the camera, and without light: per pixel and exposure."""
LINE_SD_PX = 0.7
LEAST_SHARE = 0.95
"""Smallest share of answers within 1 px of a clear stripe."""

CreateEstimator = Callable[[int], Estimator]


def rig_geometry() -> SweepGeometry:
    """A rig whose planes fan out from a mirror on the left of the camera."""
    matrix = np.array([[FOCAL_PX, 0, (WIDTH - 1) / 2], [0, FOCAL_PX, (ROWS - 1) / 2], [0, 0, 1.0]])
    angle = np.arctan2(np.linspace(-1.2, 1.2, COLUMNS) + BASELINE_M, 3.0)
    normal = np.column_stack([np.cos(angle), np.zeros(COLUMNS), -np.sin(angle)])
    planes = np.column_stack([normal, -BASELINE_M * normal[:, 0]])
    model = RigModel(Camera(WIDTH, ROWS, matrix, np.zeros(5)), PlaneTable(np.arange(float(COLUMNS)), planes))
    return sweep_geometry(model, np.arange(float(COLUMNS)), RANGE_M)


def true_stripe_px() -> NDArray[np.float32]:
    """Position in px of the stripe on a wall at 3 to 3.4 m, float32 (rows, columns)."""
    angle = np.arctan2(np.linspace(-1.2, 1.2, COLUMNS) + BASELINE_M, 3.0)
    depth_m = np.linspace(3.0, 3.4, ROWS)[:, None]
    x_m = -BASELINE_M + depth_m * np.tan(angle)
    return np.asarray(FOCAL_PX * x_m / depth_m + (WIDTH - 1) / 2, np.float32)


def flux(geometry: SweepGeometry) -> NDArray[np.float64]:
    """Photons per pixel and exposure, (columns, rows, width): fog that fades away from the camera, then the wall."""
    x = np.arange(float(WIDTH))
    behind = x - true_stripe_px().T[:, :, None]
    if not geometry.near_is_left:
        behind = -behind
    line = np.exp(-0.5 * (behind / LINE_SD_PX) ** 2)
    return np.asarray(DARK + HAZE * np.exp(-np.maximum(-behind, 0) / 60.0) * (behind < 0) + SIGNAL * line)


def sweep_of(counts: NDArray[np.unsignedinteger], geometry: SweepGeometry, exposures: int) -> CountVolume:
    """A counted sweep from counts of whole rows (columns, rows, width), cut to the geometry's windows. Column 3 has no
    frames."""
    used = np.zeros((COLUMNS, ROWS, geometry.window), counts.dtype)
    for column, first in enumerate(geometry.x0):
        part = counts[column, :, first : first + geometry.window]
        used[column, :, : part.shape[1]] = part
    n_frames = np.full(COLUMNS, exposures, np.int32)
    n_frames[3] = 0
    used[3] = 0
    generator = np.random.default_rng(5)
    return CountVolume(
        counts=used,
        x0=geometry.x0,
        exposures=exposures,
        n_frames=n_frames,
        column=np.where(n_frames > 0, np.arange(float(COLUMNS)), np.nan),
        dark_counts=generator.binomial(50, DARK, (ROWS, WIDTH)).astype(np.uint32),
        n_dark=50,
        width=WIDTH,
    )


def require_promises(table: StripeTable, sweep: CountVolume, geometry: SweepGeometry) -> None:
    """Assert what a stripe table promises for any counts (`rig.geometry.stripe_table.StripeTable`)."""
    asked = (geometry.x_lo <= geometry.x_hi) & (sweep.n_frames > 0)
    for name, values in table.arrays().items():
        assert values.dtype == np.float32, name
        assert values.shape == (ROWS, COLUMNS), name
    for name in ("x_px", "x_sd_px", "signal", "haze"):
        np.testing.assert_array_equal(np.isfinite(getattr(table, name)), asked, err_msg=name)
    assert ((table.confidence >= 0) & (table.confidence <= 1)).all()
    assert not table.confidence[~asked].any()
    assert (table.x_sd_px[asked] > 0).all()
    assert (table.signal[asked] >= 0).all()
    assert (table.haze[asked] >= 0).all()
    assert (table.x_px[asked] >= geometry.x_lo[asked] - 2).all()
    assert (table.x_px[asked] <= geometry.x_hi[asked] + 2).all()


class EstimatorSuite:
    """Tests of an estimator. The fixture `create_estimator` gives a function that takes a number of threads and returns
    a fresh estimator."""

    @pytest.fixture
    def geometry(self) -> SweepGeometry:
        """The geometry of the suite's rig."""
        return rig_geometry()

    @pytest.fixture
    def street(self, geometry: SweepGeometry) -> CountVolume:
        """A sweep with a stripe that nobody can miss."""
        detected = -np.expm1(-flux(geometry))
        counts = np.random.default_rng(1).binomial(EXPOSURES, detected).astype(np.uint8)
        return sweep_of(counts, geometry, EXPOSURES)

    def test_a_clear_stripe_is_found_and_believed(
        self, create_estimator: CreateEstimator, street: CountVolume, geometry: SweepGeometry
    ) -> None:
        estimator = create_estimator(1)
        table = estimator.estimate(street, geometry)
        require_promises(table, street, geometry)
        true_px = np.where(street.n_frames > 0, true_stripe_px(), np.float32(np.nan))
        errors = stripe_errors(table.x_px, true_px)
        assert errors["within_1px"] is not None
        assert errors["within_1px"] >= LEAST_SHARE
        assert np.nanmedian(table.confidence[:, street.n_frames > 0]) > 0.9
        assert np.nanmedian(table.signal) > 0

    def test_answers_depend_neither_on_threads_nor_on_who_asks(
        self, create_estimator: CreateEstimator, street: CountVolume, geometry: SweepGeometry
    ) -> None:
        one, three = (create_estimator(threads).estimate(street, geometry).arrays() for threads in (1, 3))
        assert one.keys() == three.keys()
        for name, values in one.items():
            np.testing.assert_array_equal(values, three[name], err_msg=name)

    @pytest.mark.parametrize(
        ("exposures", "level"), [(1, 0.0), (1, 1.0), (10, 0.0), (10, 1.0), (10, 0.5), (300, 1e-3), (300, 1.0)]
    )
    def test_frames_without_any_stripe_give_answers_that_keep_the_promises(
        self, create_estimator: CreateEstimator, geometry: SweepGeometry, exposures: int, level: float
    ) -> None:
        generator = np.random.default_rng(2)
        drawn = generator.binomial(exposures, level, (COLUMNS, ROWS, WIDTH))
        counts = drawn.astype(np.uint8) if exposures < 256 else drawn.astype(np.uint16)
        sweep, estimator = sweep_of(counts, geometry, exposures), create_estimator(1)
        for _ in range(2):  # those that learn use what they have learned
            require_promises(estimator.estimate(sweep, geometry), sweep, geometry)

    def test_its_counter_takes_packed_frames_and_what_it_counts_is_estimated(
        self, create_estimator: CreateEstimator, geometry: SweepGeometry
    ) -> None:
        exposures = EXPOSURES
        layout = SweepLayout(COLUMNS, ROWS, WIDTH, geometry.x0, geometry.window, exposures)
        estimator = create_estimator(1)
        counter = estimator.counter(layout, geometry)
        generator = np.random.default_rng(3)
        lit = np.repeat(-np.expm1(-flux(geometry)), exposures, axis=0)
        frames = np.packbits(generator.random(lit.shape) < lit, axis=2)  # the width is a multiple of 64 bits
        bins = np.repeat(np.arange(COLUMNS, dtype=np.int32), exposures)
        place = np.repeat(np.arange(float(COLUMNS)), exposures) + np.tile(
            (np.arange(exposures) + 0.5) / exposures - 0.5, COLUMNS
        )
        for _ in range(2):
            counter.reset()
            for first in range(0, len(frames), 7):
                part = slice(first, first + 7)
                counter.add(frames[part], bins[part], place[part], np.zeros(len(bins[part]), np.int32))
                counter.settle()
            tally = counter.finish()
            assert (tally.n_frames == exposures).all()
            table = estimator.estimate(tally, geometry)
            assert np.isfinite(table.x_px).all()
            errors = stripe_errors(table.x_px, true_stripe_px())
            assert errors["within_1px"] is not None
            assert errors["within_1px"] >= LEAST_SHARE
