"""A small apparatus for tests: a slanted surface, light by a formula that is easy to compute by hand, no fog.

It stands in for the simulator where a test needs only that. A lit column shows as a Gaussian of 0.6 columns on the
surface. Haze, if asked for, is an even level on the near side of the surface. Draws of all calls come from one seed.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.model.camera import Camera
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PivotScanner
from rig.simd import Float64
from rig.strategies.apparatus import PulseTimes, Rule, Spent
from rig.strategies.strategy import ColumnGeometry

LIGHT_M_PER_S = 299_792_458.0
WIDTH, HEIGHT, COLUMNS = 160, 32, 160
SIGMA_COLUMNS = 0.6
RANGE_M = (1.0, 10.0)


def plain_rig(height: int = HEIGHT, width: int = WIDTH) -> RigModel:
    """A camera of f = 180 px with the mirror 0.3 m on its left."""
    matrix = np.array([[180.0, 0, (width - 1) / 2], [0, 180.0, (height - 1) / 2], [0, 0, 1]])
    scanner = PivotScanner(np.array([-0.3, 0, 0]), np.array([0, 1.0, 0]), np.array([1.0, 0, 0]), np.array([0.08, 0.4]))
    return RigModel(Camera(width, height, matrix, np.zeros(5)), scanner, source_m=np.array([-0.3, 0, 0]))


def plain_geometry(model: RigModel | None = None, columns: int = COLUMNS) -> ColumnGeometry:
    """Columns evenly spaced over nine tenths of the mirror's range, all rows."""
    model = plain_rig() if model is None else model
    commands = (np.arange(columns) + 0.5) / columns * 1.8 - 0.9
    return ColumnGeometry(model, commands, RANGE_M, np.arange(model.camera.height))


@dataclass
class PlainScene:
    """An apparatus. signal_per_s: detections per second of a pixel in a lit column, if one column has all the power.

    ambient_per_s: of every pixel. haze: level on the near side, as a share of the signal.
    """

    geometry: ColumnGeometry = field(default_factory=plain_geometry)
    signal_per_s: float = 1e6
    ambient_per_s: float = 200.0
    haze: float = 0.0
    rule: Rule = "energy"
    seed: int = 0
    power_w: float = 0.05
    spad_frame_s: float = 1e-5
    camera_frame_s: float = 1e-3
    camera_full_scale: int = 4095
    depths_m: tuple[float, float] = (3.0, 5.0)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._spent = Spent(0.0, 0.0)

    @property
    def rows(self) -> NDArray[np.int64]:
        return self.geometry.rows

    @property
    def width(self) -> int:
        return self.geometry.shape[1]

    @property
    def columns(self) -> int:
        return self.geometry.columns

    @property
    def spent(self) -> Spent:
        return self._spent

    @cached_property
    def depth_m(self) -> Float64:
        """Depth (rows, width): a plane that recedes from left to right and a little from row to row."""
        rows, width = self.geometry.shape
        near, far = self.depths_m
        inverse = 1 / near + (1 / far - 1 / near) * np.linspace(0, 1, width)
        return 1 / (inverse + 0.01 * np.linspace(0, 1, rows)[:, None] / near)

    @cached_property
    def light(self) -> Float64:
        """Detections per second (columns, rows, width) if a column has all the power."""
        column = self.geometry.column_of(self.depth_m)
        away = np.arange(self.columns)[:, None, None] - column
        lit = np.exp(-0.5 * (away / SIGMA_COLUMNS) ** 2)
        return self.signal_per_s * np.nan_to_num(lit + self.haze * (away < 0))

    def _shares(self, patterns: NDArray[np.float32]) -> Float64:
        lit = np.asarray(patterns, np.float64)
        if self.rule == "irradiance":
            return lit / (self.columns / 2)
        return lit / np.maximum(lit.sum(axis=-1, keepdims=True), 1e-30)

    def _flux(self, pattern: NDArray[np.float32]) -> Float64:
        share = self._shares(pattern)
        spread = "c,crx->rx" if share.ndim == 1 else "rc,crx->rx"
        return np.einsum(spread, share, self.light) + self.ambient_per_s

    def _charge(self, patterns: NDArray[np.float32], times_s: Float64) -> None:
        energy = self.power_w * sum(
            float(np.mean(np.sum(self._shares(one), axis=-1))) * t for one, t in zip(patterns, times_s, strict=True)
        )
        self._spent = Spent(self._spent.time_s + float(np.sum(times_s)), self._spent.energy_j + energy)

    def spad_counts(self, patterns: NDArray[np.float32], frames: NDArray[np.int64]) -> NDArray[np.uint32]:
        self._charge(patterns, frames * self.spad_frame_s)
        rates = [-np.expm1(-self._flux(one) * self.spad_frame_s) for one in patterns]
        return np.array([self._rng.binomial(n, rate) for n, rate in zip(frames, rates, strict=True)], np.uint32)

    def camera_images(self, patterns: NDArray[np.float32], exposure_s: float) -> NDArray[np.uint16]:
        assert exposure_s >= self.camera_frame_s * (1 - 1e-9)
        self._charge(patterns, np.full(len(patterns), exposure_s))
        electrons = np.array([self._rng.poisson(self._flux(one) * exposure_s) for one in patterns])
        read = self._rng.normal(0, 2.0, electrons.shape)
        return np.clip(np.rint(electrons / 3 + 20 + read), 0, self.camera_full_scale).astype(np.uint16)

    def spots(
        self, rows: NDArray[np.int64], columns: NDArray[np.int64], frames: int, brightness: float = 1.0
    ) -> NDArray[np.uint32]:
        taken_s = len(rows) * frames * self.spad_frame_s
        self._spent = Spent(self._spent.time_s + taken_s, self._spent.energy_j + taken_s * brightness * self.power_w)
        brighter = brightness * self.geometry.shape[0]
        flux = brighter * self.light[columns, rows] + self.ambient_per_s
        return self._rng.binomial(frames, -np.expm1(-flux * self.spad_frame_s)).astype(np.uint32)

    def pulse_times(self, pulses: int, bin_s: float) -> PulseTimes:
        self._charge(np.ones((1, self.columns), np.float32), np.array([pulses * self.spad_frame_s]))
        path = 2 * np.sqrt(1 + self.geometry.u**2 + self.geometry.v**2) / LIGHT_M_PER_S
        start_s, end_s = RANGE_M[0] * path.min() * 0.9, RANGE_M[1] * path.max() * 1.1
        bins = int(np.ceil((end_s - start_s) / bin_s))
        mean = self.signal_per_s / self.columns * self.spad_frame_s
        edges = start_s + bin_s * np.arange(bins + 1)
        arrival = (self.depth_m * path)[..., None]
        cdf = 0.5 * (1 + np.tanh(0.8 * (edges - arrival) / 3e-10))
        rate = mean * np.diff(cdf, axis=-1) + self.ambient_per_s * bin_s
        passed = np.concatenate([np.zeros((*rate.shape[:2], 1)), np.cumsum(rate, axis=-1)], axis=-1)
        chance = np.diff(-np.expm1(-passed), axis=-1)
        rest = np.exp(-passed[..., -1:])
        drawn = self._rng.multinomial(pulses, np.concatenate([chance, rest], axis=-1))
        return PulseTimes(drawn[..., :-1].astype(np.uint32), start_s, bin_s, pulses)

    def stereo_pair(self, exposure_s: float) -> NDArray[np.uint16]:
        raise NotImplementedError("this scene has no texture")
