"""Binary frames: exact statistics, packed order, and the same bits however the work is cut."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_backend.flux import FluxModel
from sim_backend.photon_kernels import PLANES, bit_planes, draw_frames, dropped_frames, frame_key
from sim_backend.photons import PhotonSource
from tests.unit.sim.rigs import rig, setting, wall


def _planes(flux: NDArray[np.float64]) -> NDArray[np.uint64]:
    rows, width = flux.shape
    planes = np.zeros((rows, -(-width // 64), PLANES), np.uint64)
    bit_planes(flux, np.zeros_like(flux), 1.0, 0.0, np.zeros((0, 1, PLANES), np.uint64), 0, rows, planes)
    return planes


def _draw(flux: NDArray[np.float64], frames: int, seed: int = 3, first: int = 0) -> NDArray[np.uint8]:
    planes = _planes(flux)
    words = np.empty((frames, *planes.shape[:2]), np.uint64)
    draw_frames(planes, np.uint64(seed), first, 0, len(flux), np.zeros(frames, np.int32), words)
    return np.unpackbits(words.view(np.uint8).reshape(frames, len(flux), -1), axis=-1)


def test_bit_planes_hold_the_probability_to_32_bits_in_packbits_order() -> None:
    rng = np.random.default_rng(5)
    flux = np.exp(rng.uniform(-14, 2.5, (7, 100)))
    bits = np.unpackbits(_planes(flux).view(np.uint8).reshape(7, 2, PLANES, 8), axis=-1)
    p = np.einsum("ywpi,p->ywi", bits, 2.0 ** -np.arange(1, PLANES + 1)).reshape(7, 128)
    np.testing.assert_allclose(p[:, :100], -np.expm1(-flux), rtol=0, atol=0.6 * 2.0**-32)
    assert np.all(p[:, 100:] == 0)


def test_every_pixel_counts_as_bernoulli_says() -> None:
    rng = np.random.default_rng(6)
    flux = rng.choice([1e-3, 0.01, 0.1, 0.7, 2.0, 5.0], (16, 70))
    n = 20_000
    counts = sum(_draw(flux, 2000, first=2000 * i).sum(axis=0, dtype=np.int64) for i in range(10))
    p = -np.expm1(-flux)
    z = (counts[:, :70] - n * p) / np.sqrt(n * p * (1 - p))
    assert abs(z.mean()) < 4 / np.sqrt(z.size)
    assert z.std() == pytest.approx(1.0, abs=4 / np.sqrt(2 * z.size))
    assert np.all(counts[:, 70:] == 0)


def test_pixels_and_frames_are_independent() -> None:
    bits = _draw(np.full((8, 64), np.log(2.0)), 4000).astype(np.float64) - 0.5
    flat = bits.reshape(4000, -1) * 2
    n = 4000
    for lag in (1, 2, 7, 64, 65):  # neighbours along the row, along the column
        c = (flat[:, lag:] * flat[:, :-lag]).mean(axis=0)
        assert np.sqrt((c**2).mean()) == pytest.approx(1 / np.sqrt(n), rel=0.15)
    following = (flat[1:] * flat[:-1]).mean(axis=0)
    assert np.sqrt((following**2).mean()) == pytest.approx(1 / np.sqrt(n), rel=0.15)


def test_certain_and_impossible_pixels() -> None:
    flux = np.array([[0.0, 1e3, 40.0, 0.0]])
    assert np.array_equal(_draw(flux, 3)[:, 0, :4], [[0, 1, 1, 0]] * 3)


def test_seeds_and_frames_have_streams_of_their_own() -> None:
    keys = {int(frame_key(np.uint64(s), np.uint64(f))) for s in range(50) for f in range(200)}
    assert len(keys) == 50 * 200


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("block", [1, 7, 40])
def test_bits_do_not_depend_on_block_size_or_threads(threads: int, block: int) -> None:
    model = rig(size=(21, 70))
    flux = FluxModel(setting(model, wall(model, (0.1, 0, 1), 2.0), medium={"extinction": "0.1 /m"}))

    def frames(block: int, threads: int) -> NDArray[np.uint8]:
        source = PhotonSource(flux, model.planes, 1e-5, 9, threads)
        held = np.repeat([np.nan, 0.1, 0.2, 0.1, np.nan], 8)
        power = np.full(40, 0.5)
        power[11], power[20:23] = 0.2, 0.0
        bits = np.full((40, 21, 16), 255, np.uint8)
        for first in range(0, 40, block):
            part = slice(first, first + block)
            source.expose(100 + first, held[part], power[part], np.zeros(len(bits[part]), np.int32), bits[part])
        source.close()
        return bits

    assert np.array_equal(frames(block, threads), frames(40, 1))


def test_a_window_has_the_very_bits_of_the_whole_frame() -> None:
    model = rig(size=(9, 200))
    flux = FluxModel(setting(model, wall(model, (0.1, 0, 1), 2.0), medium={"extinction": "0.1 /m"}))
    held, power = np.repeat([np.nan, 0.1, 0.2], 4), np.full(12, 0.5)
    x0 = np.array([0, 64, 128, 0] * 3, np.int32)
    source = PhotonSource(flux, model.planes, 1e-5, 9, 2)
    whole, window = np.empty((12, 9, 32), np.uint8), np.empty((12, 9, 16), np.uint8)
    source.expose(7, held, power, np.zeros(12, np.int32), whole)
    source.expose(7, held, power, x0, window)
    source.close()
    assert whole.any()
    for frame in range(12):
        at = x0[frame] // 8
        assert np.array_equal(window[frame], whole[frame, :, at : at + 16])


def test_frames_get_lost_with_the_given_chance_whatever_the_block() -> None:
    whole = dropped_frames(np.uint64(4), 0, 20_000, 0.1)
    assert whole.mean() == pytest.approx(0.1, abs=0.01)
    parts = np.concatenate([dropped_frames(np.uint64(4), f, 500, 0.1) for f in range(0, 20_000, 500)])
    assert np.array_equal(parts, whole)
