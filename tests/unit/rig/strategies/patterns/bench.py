"""A small bench of its own: a mirror, a camera and a wall, computed from nothing that is tested.

The mirror stands 0.3 m left of the camera and turns about the vertical. A pixel sees light of the columns around the
one that falls on its surface, shared as a Gaussian.
"""

from dataclasses import dataclass, field

import numpy as np

from calibration.files.rig_file import load_rig_model
from rig.config.overrides import configure
from rig.strategies.apparatus import Budget, Spent
from rig.strategies.strategy import ColumnGeometry, Strategy, TooShort

F_PX, CENTRE_PX, WIDTH = 600.0, 255.5, 512
BASELINE_M, ANGLE0, PER_COMMAND = 0.3, 0.0872, 0.5315
COLUMNS = 500
COMMANDS = -0.88 + (np.arange(COLUMNS) + 0.5) * 1.76 / COLUMNS
ROWS = np.arange(100, 102)
DEPTH_RANGE_M = (1.0, 15.0)


def geometry(rows=ROWS):
    config = configure("simulated")
    return ColumnGeometry(load_rig_model(config.calibration), COMMANDS, DEPTH_RANGE_M, rows)


def true_column(depth_m):
    """Column (rows, width) that falls on surfaces at depth_m (rows, width)."""
    u = (np.arange(WIDTH) - CENTRE_PX) / F_PX
    angle = np.arctan((u * depth_m + BASELINE_M) / depth_m)
    return ((angle - ANGLE0) / PER_COMMAND + 0.88) * COLUMNS / 1.76 - 0.5


def walls(seed=0):
    """Depths of a slanted wall with steps, (rows, width) in metres."""
    rng = np.random.default_rng(seed)
    x = np.arange(WIDTH)
    depth = 3.0 + 0.004 * x + 4.0 * (x > 200) - 3.2 * (x > 380)
    return np.tile(depth, (len(ROWS), 1)) * rng.uniform(0.95, 1.05, (len(ROWS), 1))


@dataclass
class Bench:
    """signal, ambient: photons per second of a lit column and without any light. haze: of every column's light."""

    depth_m: np.ndarray
    signal: float = 1e5
    ambient: float = 100.0
    blur_columns: float = 0.55
    noiseless: bool = False
    seed: int = 0
    rows: np.ndarray = field(default_factory=lambda: ROWS)
    width: int = WIDTH
    columns: int = COLUMNS
    spad_frame_s: float = 1e-5
    camera_frame_s: float = 1e-3
    camera_full_scale: int = 4095
    electrons_per_level: float = 4.0
    read_noise: float = 5.0
    time_s: float = 0.0

    def __post_init__(self):
        self.rng = np.random.default_rng(self.seed)
        away = np.arange(COLUMNS) - true_column(self.depth_m)[..., None]
        self.share = np.exp(-0.5 * (away / self.blur_columns) ** 2)
        self.share /= np.maximum(self.share.sum(axis=-1, keepdims=True), 1e-9)
        self.calls = []

    @property
    def spent(self):
        return Spent(self.time_s, self.time_s)

    def rates(self, patterns):
        lit = patterns * (COLUMNS / 2) / np.maximum(patterns.sum(axis=-1, keepdims=True), 1e-9)
        return self.ambient + self.signal * np.tensordot(lit, self.share, (1, 2))

    def spad_counts(self, patterns, frames):
        self.time_s += float(frames.sum()) * self.spad_frame_s
        self.calls.append(len(patterns))
        p = -np.expm1(-self.rates(patterns) * self.spad_frame_s)
        n = np.broadcast_to(frames[:, None, None], p.shape)
        return (np.rint(n * p) if self.noiseless else self.rng.binomial(n, p)).astype(np.uint32)

    def camera_images(self, patterns, exposure_s):
        assert exposure_s >= self.camera_frame_s
        self.time_s += len(patterns) * exposure_s
        self.calls.append(len(patterns))
        electrons = self.rates(patterns) * exposure_s
        if not self.noiseless:
            electrons = self.rng.poisson(electrons) + self.rng.normal(0, self.read_noise, electrons.shape)
        return np.clip(np.rint(electrons / self.electrons_per_level), 0, self.camera_full_scale).astype(np.uint16)


def off_columns(answer, depth_m):
    """Error in columns of an answer's depths, (rows, width)."""
    return true_column(answer.depth_m.astype(np.float64)) - true_column(depth_m)


def seen(depth_m):
    """Pixels whose surface is lit by some column."""
    column = true_column(depth_m)
    return (column >= 0) & (column <= COLUMNS - 1)


def confident_answers(strategy: Strategy, time_s: float) -> tuple[int, int]:
    """Numbers of confident answers and of wrong ones among them, over walls in four lights."""
    sure, wrong = 0, 0
    for seed, signal in enumerate((500.0, 2e3, 8e3, 3e4)):
        depth = walls(seed)
        answer = strategy.measure(Bench(depth, signal=signal, seed=seed), geometry(), Budget(time_s), 0)
        confident = (answer.confidence >= 0.9) & seen(depth)
        sure += int(confident.sum())
        wrong += int((confident & ~(np.abs(answer.depth_m - depth) <= 0.02 * depth)).sum())
    return sure, wrong


def check_time(strategy: Strategy, times_s: tuple[float, ...]) -> None:
    """Each time is kept, or refused before any light."""
    for time_s in times_s:
        bench = Bench(walls())
        try:
            strategy.measure(bench, geometry(), Budget(time_s), 0)
        except TooShort:
            assert not bench.calls
        assert bench.time_s <= time_s * (1 + 1e-9)
