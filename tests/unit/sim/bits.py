"""Whole frames of bits for tests of what the sensor does to them."""

import numpy as np
from numpy.typing import NDArray

from sim_backend.effects.sensor_bits import packed
from sim_backend.effects.setting import BitEffect, FrameTimes, Setting
from sim_backend.light.optics import Sensor
from tests.unit.sim.rigs import rig, setting, wall

TIMES = FrameTimes(exposure_s=10e-6, period_s=10e-6)
WIDTH, ROWS = 150, 20
"""Rows that end within a word."""
Bits = NDArray[np.bool_]


def sensor_setting(**sensor: str | int) -> Setting:
    """A wall before a sensor of ROWS x WIDTH pixels with these keys."""
    model = rig(size=(ROWS, WIDTH))
    made = setting(model, wall(model, (0.0, 0.0, 1.0), 2.0))
    return Setting(made.view, made.scene, made.optics, Sensor.model_validate(sensor), made.line, made.gain)


def acted_on(
    effect: BitEffect, bits: Bits, *, seed: int = 5, first: int = 0, block: int = 1000, times: FrameTimes = TIMES
) -> Bits:
    """What the effect makes of frames (frames, ROWS, WIDTH), which are handed to it in blocks."""
    words = np.stack([packed(frame) for frame in bits])
    found = words.copy()
    for at in range(0, len(bits), block):
        before = found[at - 1] if at else np.zeros_like(words[0])
        effect.apply(np.uint64(seed), first + at, words[at : at + block], before, times)
    seen = np.unpackbits(words.view(np.uint8).reshape(len(bits), ROWS, -1), axis=2).astype(np.bool_)
    assert not seen[:, :, WIDTH:].any(), "pad bits"
    return seen[:, :, :WIDTH]


def random_bits(frames: int, share: float, seed: int = 1) -> Bits:
    """Independent bits (frames, ROWS, WIDTH)."""
    return np.random.default_rng(seed).random((frames, ROWS, WIDTH)) < share


def assert_count(found: int, tries: int, probability: float) -> None:
    """Within 4.5 standard deviations of the binomial."""
    mean, sd = tries * probability, np.sqrt(tries * probability * (1 - probability))
    assert abs(found - mean) <= 4.5 * sd + 1e-9, f"{found} of {tries}, not {mean:.5g} +- {sd:.3g}"
