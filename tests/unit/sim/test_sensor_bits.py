"""All that the sensor does to bits, together, in the frames of a source: windows, blocks and threads do not matter."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_backend.effects import afterpulsing, sensor_bits, setting
from sim_backend.effects.setting import FrameTimes, Setting
from sim_backend.frames.flux import FluxModel
from sim_backend.frames.photons import PhotonSource
from tests.stability.inventory import covers
from tests.unit.sim.bits import ROWS, WIDTH, sensor_setting
from tests.unit.sim.rigs import rig

covers(afterpulsing, sensor_bits, setting)

TIMES = FrameTimes(exposure_s=1e-6, period_s=1e-6)
FRAMES, FIRST = 40, 100
EVERYTHING = {
    "dark_rate": "200 kcps",
    "afterpulsing": "30 %",
    "trap_lifetime": "1 us",
    "dead_time": "500 ns",
    "crosstalk": "20 %",
    "dead_share": "3 %",
    "hot_share": "2 %",
    "bit_error_rate": "1 %",
}


def _frames(
    scene: Setting, *, block: int = FRAMES, threads: int = 1, x0: NDArray[np.int32] | None = None
) -> NDArray[np.uint8]:
    """Frames FIRST, FIRST + 1, ... packed: whole ones, or windows of 64 pixels from x0 (FRAMES,)."""
    source = PhotonSource(FluxModel(scene), rig(size=(ROWS, WIDTH)).sheets, TIMES, 9, threads)
    held = np.repeat([np.nan, 0.1, 0.2, 0.1, np.nan], FRAMES // 5)
    bits = np.full((FRAMES, ROWS, 24 if x0 is None else 8), 255, np.uint8)
    x0 = np.zeros(FRAMES, np.int32) if x0 is None else x0
    for first in range(0, FRAMES, block):
        part = slice(first, first + block)
        n = len(held[part])
        source.expose(FIRST + first, held[part], np.full(n, 5.0), x0[part], bits[part], np.zeros(n))
    source.close()
    return bits


@pytest.mark.parametrize(("block", "threads"), [(1, 1), (7, 3), (40, 2)])
def test_bits_do_not_depend_on_blocks_or_threads(block: int, threads: int) -> None:
    scene = sensor_setting(**EVERYTHING)
    assert np.array_equal(_frames(scene, block=block, threads=threads), _frames(scene))


def test_a_window_has_the_very_bits_of_the_whole_frame() -> None:
    scene = sensor_setting(**EVERYTHING)
    x0 = np.tile([0, 64, 128, 64], FRAMES // 4).astype(np.int32)
    whole, windows = _frames(scene), _frames(scene, x0=x0)
    for f in range(FRAMES):
        assert np.array_equal(windows[f], whole[f, :, x0[f] // 8 : x0[f] // 8 + 8])


def test_effects_act_in_the_order_of_the_way_from_the_diode_to_the_link() -> None:
    model = FluxModel(sensor_setting(**EVERYTHING))
    assert list(model.bits) == ["afterpulsing and dead time", "crosstalk", "hot and dead pixels", "bit errors"]
    assert not FluxModel(sensor_setting()).bits


def test_pad_bits_stay_zero() -> None:
    assert not np.unpackbits(_frames(sensor_setting(**EVERYTHING)), axis=2)[:, :, WIDTH:].any()
