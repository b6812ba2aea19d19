"""Planes before a camera, by closed forms that share nothing with the strategies: pulses, a dot picture, two views.

The camera is a pinhole, the mirror turns about a vertical axis beside it, so a point with ray (u, v, 1) at depth z is
lit at the angle atan(u + b / z). Photons of a pulse come from a Gaussian, those of fog by the lidar equation, and one
after the other they are drawn from the distribution of the first one.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from calibration.model.camera import Camera
from calibration.model.rig_model import RigModel
from calibration.model.scanner import PivotScanner
from rig.simd import Float64
from rig.strategies.apparatus import PulseTimes, Spent
from rig.strategies.strategy import ColumnGeometry

C = 299_792_458.0


@dataclass
class PlaneScene:
    """A plane 1/z = inverse + tilt u. All light is in photons per pixel.

    lit, haze, ambient: photons of a fully lit dot, of the haze of the whole pattern, and of the surroundings, in a
    second of the whole source. photons, fog, flat: in a pulse, of the surface, of the fog before it, and of the
    surroundings over the gate.
    """

    inverse: float = 0.3
    tilt: float = 0.0
    rows_number: int = 40
    width: int = 200
    focal_px: float = 300.0
    baseline_m: float = 0.3
    lit: float = 2e6
    haze: float = 0.0
    ambient: float = 0.0
    photons: float = 0.02
    fog: float = 0.0
    extinction: float = 0.1
    flat: float = 0.0
    read_noise: float = 0.0
    columns: int = 400
    range_m: tuple[float, float] = (1.0, 10.0)
    pulse_sigma_s: float = 1e-10
    spad_frame_s: float = 1e-5
    camera_frame_s: float = 1e-3
    camera_full_scale: int = 65535
    seed: int = 0
    spent: Spent = field(default_factory=lambda: Spent(0.0, 0.0))
    rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.rows = np.arange(self.rows_number)
        self.u = (np.arange(self.width) - (self.width - 1) / 2) / self.focal_px
        self.v = (np.arange(self.rows_number) - (self.rows_number - 1) / 2) / self.focal_px

    @property
    def depth_m(self) -> Float64:
        return np.broadcast_to(1 / (self.inverse + self.tilt * self.u), (self.rows_number, self.width))

    @property
    def stretch(self) -> Float64:
        """Range over depth of each pixel."""
        return np.sqrt(1 + self.u**2 + self.v[:, None] ** 2)

    @property
    def geometry(self) -> ColumnGeometry:
        middle_x, middle_y = (self.width - 1) / 2, (self.rows_number - 1) / 2
        matrix = np.array([[self.focal_px, 0, middle_x], [0, self.focal_px, middle_y], [0, 0, 1]])
        left = np.array([-self.baseline_m, 0, 0])
        scanner = PivotScanner(left, np.array([0, 1.0, 0]), np.array([1.0, 0, 0]), np.array([0.1, 0.45]))
        model = RigModel(Camera(self.width, self.rows_number, matrix, np.zeros(5)), scanner, source_m=left)
        return ColumnGeometry(model, (np.arange(self.columns) + 0.5) / self.columns * 2 - 1, self.range_m, self.rows)

    def _spend(self, time_s: float) -> None:
        self.spent = Spent(self.spent.time_s + time_s, self.spent.energy_j)

    def column(self) -> Float64:
        """Column (rows, width) that lights each pixel."""
        angle = np.arctan(self.u + self.baseline_m / self.depth_m)
        return ((angle - 0.1) / 0.45 + 1) / 2 * self.columns - 0.5

    def light_per_s(self, pattern: np.ndarray) -> Float64:
        """Photons a second (rows, width) of a pattern (rows, columns): the surface is lit as a line of 0.6 columns."""
        pattern = np.broadcast_to(pattern, (self.rows_number, self.columns)).astype(float)
        away = np.arange(self.columns) - self.column()[..., None]
        share = np.exp(-0.5 * (away / 0.6) ** 2)
        lit = np.einsum("rc,rxc->rx", pattern, share / share.sum(axis=-1, keepdims=True))
        return self.lit * lit + self.haze * pattern.mean() + self.ambient

    def spad_counts(self, patterns: np.ndarray, frames: np.ndarray) -> np.ndarray:
        self._spend(float(frames.sum()) * self.spad_frame_s)
        fired = [-np.expm1(-self.light_per_s(pattern) * self.spad_frame_s) for pattern in patterns]
        return np.array([self.rng.binomial(n, p) for n, p in zip(frames, fired, strict=True)], np.uint32)

    def camera_images(self, patterns: np.ndarray, exposure_s: float) -> np.ndarray:
        self._spend(len(patterns) * exposure_s)
        mean = np.array([self.light_per_s(pattern) * exposure_s for pattern in patterns])
        noisy = self.rng.poisson(mean) + self.rng.normal(0, max(self.read_noise, 1e-9), mean.shape)
        return np.clip(np.rint(noisy), 0, self.camera_full_scale).astype(np.uint16)

    def pulse_times(self, pulses: int, bin_s: float) -> PulseTimes:
        self._spend(pulses * self.spad_frame_s)
        path = 2 / C * self.stretch
        start_s = self.range_m[0] * path.min() - 4 * self.pulse_sigma_s
        bins = math.ceil((self.range_m[1] * path.max() + 4 * self.pulse_sigma_s - start_s) / bin_s)
        edges = start_s + bin_s * np.arange(bins + 1)
        arrival = self.depth_m * path
        sigmas = np.linspace(-7, 7, 7001)
        passed = [0.5 * math.erfc(-sigma / math.sqrt(2)) for sigma in sigmas]
        pulse = np.diff(np.interp((edges - arrival[..., None]) / self.pulse_sigma_s, sigmas, passed), axis=-1)
        range_m = C * (edges[:-1] + edges[1:]) / 4
        curve = np.exp(-2 * self.extinction * range_m) / range_m**2 * (edges[1:] < arrival[..., None])
        fog = self.fog * curve / curve.sum(axis=-1, keepdims=True)
        rate = self.photons * pulse + fog + self.flat / bins
        before = np.cumsum(rate, axis=-1) - rate
        first = np.exp(-before) * -np.expm1(-rate)
        none = np.maximum(1 - first.sum(axis=-1, keepdims=True), 0)
        share = np.concatenate([first, none], axis=-1)
        drawn = self.rng.multinomial(pulses, share / share.sum(axis=-1, keepdims=True))
        return PulseTimes(drawn[..., :-1].astype(np.uint32), start_s, bin_s, pulses)

    def _painted(self, u: Float64, z: Float64) -> Float64:
        """Brightness 0 to 1 of the plane's points: a few random waves along it, the same from wherever it is seen."""
        along = u * z
        waves = np.random.default_rng(self.seed + 2)
        per_m = waves.uniform(5, 0.2 * self.focal_px * self.inverse * 2 * math.pi, 24)
        phase = waves.uniform(0, 2 * math.pi, (self.rows_number, 24))
        smooth = phase + np.cumsum(waves.normal(0, 0.3, phase.shape), axis=0)
        sines = np.sin(along[..., None] * per_m + smooth[:, None])
        return 0.5 + 0.5 * np.clip(sines.mean(axis=-1) * 3, -1, 1)

    def stereo_pair(self, exposure_s: float) -> np.ndarray:
        self._spend(exposure_s)
        mean = self.mean_pair(exposure_s)
        noisy = self.rng.poisson(mean) + self.rng.normal(0, max(self.read_noise, 1e-9), mean.shape)
        return np.clip(np.rint(noisy), 0, self.camera_full_scale).astype(np.uint16)

    def mean_pair(self, exposure_s: float) -> np.ndarray:
        """Mean photons (2, rows, width) of both views."""
        views = []
        for shift in (0.0, -self.baseline_m):
            u = np.broadcast_to(self.u, (self.rows_number, self.width))
            # The plane 1 = inverse z + tilt x meets the ray from x = shift.
            z = (1 - self.tilt * shift) / (self.inverse + self.tilt * u)
            x = shift + u * z
            views.append(exposure_s * (self.lit * self._painted(x / z, z) + self.haze + self.ambient))
        return np.array(views)
