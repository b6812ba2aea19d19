"""Lidar, dots and stereo on planes against closed forms: what `strategy_checks` prints of them.

- First photon on the target, given that there is one: exp(-F) (1 - exp(-S)) / (1 - exp(-F - S)), for F photons of fog
  before a surface of S photons in a pulse.
- Range error of a lidar against the Cramer-Rao bound: with A photons from the surface and b background counts a second

      sd = c / 2 / sqrt(integral of (A g')^2 / (A g + b) dt),      without background c sigma / (2 sqrt(A)).

  The pulse g has the variance of the instrument and of a bin, sigma^2 + width^2 / 12.
- Disparity of dots against the bound of a block with read noise s and photons n: variance = sum of g^2 (n + s^2) over
  (sum of g^2)^2, with the picture's slope g per pixel of disparity.
- Disparity of stereo by its fraction of a pixel, as the matcher gives it and after the blocks' parabola.
- Depth of stereo against z^2 / (b f) times the disparity's error of a block. The difference of both pictures has the
  variance v = n1 + n2 + 2 s^2, and their slope, half the difference of two pixels, has v / 4. So the variance of the
  disparity is the sum of (g^2 + v / 4) v over (sum of g^2)^2. The error that the matching itself makes, without any
  noise, comes on top.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from rig.strategies import dots, lidar, passive_stereo
from rig.strategies.apparatus import Budget
from rig.strategies.block_matching import BLOCK_PX
from rig.strategies.lidar import first_photons
from tests.unit.rig.strategies.plane_scene import C, PlaneScene

INNER = (slice(6, -6), slice(8, -8))
PULSES = 100_000
CAMERA_S = 0.0015


def first_on_target(fog: float, surface: float, seed: int = 4) -> tuple[float, float, float]:
    """Share of first photons that come from the surface: closed form, as drawn, and the latter's standard deviation."""
    scene = PlaneScene(fog=fog, photons=surface, width=300, seed=seed)
    seen = scene.pulse_times(1, scene.pulse_sigma_s)
    time_s = first_photons(seen, scene.pulse_sigma_s, np.random.default_rng(seed)).time_s
    arrival_s = 2 / C * scene.depth_m * scene.stretch
    some = np.isfinite(time_s)
    # What comes within 5 standard deviations before the surface is fog as far as the light directly before it goes.
    near = np.sum(np.abs(time_s - arrival_s)[some] < 5 * scene.pulse_sigma_s)
    before = np.sum(
        ((arrival_s - time_s)[some] >= 5 * scene.pulse_sigma_s)
        & ((arrival_s - time_s)[some] < 10 * scene.pulse_sigma_s)
    )
    share = (near - before) / some.sum()
    closed = math.exp(-fog) * -math.expm1(-surface) / -math.expm1(-fog - surface)
    return closed, float(share), math.sqrt((near + before) / some.sum() ** 2)


def lidar_error_m(photons: float, background: float, strategy: lidar.FlashLidar = lidar.PEAK) -> tuple[float, float]:
    """Bound of the range error and its standard deviation as measured, in metres. background: counts in the gate."""
    scene = PlaneScene(
        inverse=0.3137, photons=photons / PULSES, flat=background / PULSES, rows_number=30, width=150, seed=int(photons)
    )
    seen = scene.pulse_times(1, scene.pulse_sigma_s)
    per_s = background / (seen.counts.shape[-1] * seen.bin_s)
    sigma_s = math.hypot(scene.pulse_sigma_s, seen.bin_s / math.sqrt(12))
    answer = strategy.measure(scene, scene.geometry, Budget(PULSES * scene.spad_frame_s), 0)
    error_m = (answer.depth_m - scene.depth_m) * scene.stretch
    return lidar_bound_m(sigma_s, photons, per_s), float(np.nanstd(error_m))


def lidar_bound_m(sigma_s: float, photons: float, per_s: float) -> float:
    """Cramer-Rao bound of the range, by numerical integration. per_s: background in counts a second."""
    t = np.linspace(-8 * sigma_s, 8 * sigma_s, 20001)
    pulse = np.exp(-0.5 * (t / sigma_s) ** 2) / (math.sqrt(2 * math.pi) * sigma_s)
    slope = photons * -t / sigma_s**2 * pulse
    return float(C / 2 / math.sqrt(np.sum(slope**2 / (photons * pulse + per_s)) * (t[1] - t[0])))


def dots_error_px(read_noise: float, inverse: float, seed: int = 5) -> tuple[float, float, float]:
    """Bound of the disparity's error, its standard deviation as measured and its mean, in pixels."""
    scene = PlaneScene(inverse=inverse, lit=3e5, read_noise=read_noise, width=240, seed=seed)
    answer = dots.CAMERA.measure(scene, scene.geometry, Budget(CAMERA_S), seed)
    px = scene.geometry.px_per_inverse_depth
    error = (px * (1 / answer.depth_m - 1 / scene.depth_m))[INNER]
    shown, step = dots.dot_pattern(scene.rows_number, scene.columns, seed), 1e-3
    mean = CAMERA_S * scene.light_per_s(shown)
    ends = [CAMERA_S * replace(scene, inverse=inverse + each).light_per_s(shown) for each in (-step, step)]
    slope = (ends[1] - ends[0]) / (2 * step * px)
    noisy, clean = (
        cv2.blur(values, BLOCK_PX[::-1])[INNER] * np.prod(BLOCK_PX)
        for values in (slope**2 * (mean + read_noise**2), slope**2)
    )
    return float(np.sqrt(np.mean(noisy / clean**2))), float(error.std()), float(error.mean())


def stereo_depth_error_mm(read_noise: float, inverse: float, seed: int = 3) -> tuple[float, float, float]:
    """Standard deviation of the depth in millimetres: that which the formula gives for the noise of both pictures, that
    of the matching itself, from pictures without noise, and that of noisy pictures.

    The plane is a little slanted, so disparities have all fractions of a pixel.
    """
    scene = PlaneScene(lit=5e5, read_noise=read_noise, width=240, seed=seed, inverse=inverse, tilt=0.05)
    means = scene.mean_pair(CAMERA_S)
    answers = (
        passive_stereo.depth_of_pair(1000 * means.astype(np.float32), scene.geometry),
        passive_stereo.SGBM.measure(scene, scene.geometry, Budget(CAMERA_S), 0),
    )
    metre_per_px = scene.depth_m[INNER] ** 2 / (scene.baseline_m * scene.focal_px)
    errors_m = [(answer.depth_m - scene.depth_m)[INNER] for answer in answers]
    near = np.all(np.abs(errors_m) < metre_per_px, axis=0)
    slope = np.gradient(means[0], axis=1)
    noise = 2 * (means[0] + read_noise**2)  # a point is as bright in both pictures
    of_noise, of_slope = (
        cv2.blur(values, BLOCK_PX[::-1])[INNER] * np.prod(BLOCK_PX)
        for values in ((slope**2 + noise / 4) * noise, slope**2)
    )
    expected_m = np.sqrt(np.mean((metre_per_px**2 * of_noise / of_slope**2)[near]))
    matching_m, found_m = (error_m[near].std() for error_m in errors_m)
    return 1e3 * float(expected_m), 1e3 * float(matching_m), 1e3 * float(found_m)


def stereo_errors_px(fraction: float, read_noise: float = 20.0) -> tuple[float, float, float, float]:
    """Mean and standard deviation of the matcher's disparity error in pixels, and the same after the blocks'
    parabola."""
    scene = PlaneScene(lit=5e5, read_noise=read_noise, width=240)
    bf = scene.baseline_m * scene.focal_px
    scene = replace(scene, inverse=(27 + fraction) / bf)
    answer = passive_stereo.SGBM.measure(replace(scene), scene.geometry, Budget(CAMERA_S), 0)
    error = (bf * (1 / answer.depth_m - scene.inverse))[INNER]
    shown = passive_stereo.detail_8_bits(scene.stereo_pair(CAMERA_S).astype(np.float32))[:, :, ::-1]
    found = passive_stereo.matched_by_opencv(*map(np.ascontiguousarray, shown), 10, 64)[:, ::-1]
    own = (found - bf * scene.inverse)[INNER]
    right, own = np.abs(error) < 1, own[np.abs(own) < 1]
    return float(own.mean()), float(own.std()), float(error[right].mean()), float(error[right].std())


def tables() -> Iterator[tuple[tuple[str, ...], Iterator[tuple[str, ...]]]]:
    """Titles and rows of each table."""
    yield (
        ("photons of fog and surface in a pulse", "first photon on the surface, closed form", "drawn"),
        (
            (f"{fog:g}, {surface:g}", f"{closed:.4f}", f"{share:.4f} +- {sd:.4f}")
            for fog, surface in ((1.0, 0.5), (0.2, 0.5), (2.0, 0.1))
            for closed, share, sd in (first_on_target(fog, surface),)
        ),
    )
    yield (
        ("lidar: photons, background in the gate", "bound, mm", "measured, mm", "ratio"),
        (
            (f"{photons}, {background}", f"{1e3 * bound:.3f}", f"{1e3 * found:.3f}", f"{found / bound:.3f}")
            for photons, background in ((30, 0), (100, 0), (1000, 0), (100, 1000), (100, 10_000), (300, 10_000))
            for bound, found in (lidar_error_m(photons, background),)
        ),
    )
    yield (
        ("dots: read noise, 1/z", "bound, px", "measured, px", "ratio", "mean, px"),
        (
            (f"{read:g}, {inverse:g}", f"{bound:.4f}", f"{found:.4f}", f"{found / bound:.2f}", f"{mean:+.4f}")
            for read in (100.0, 50.0, 5.0)
            for inverse in (0.3137, 0.62)
            for bound, found, mean in (dots_error_px(read, inverse),)
        ),
    )
    yield (
        ("stereo: fraction of a pixel", "matcher: mean, sd, px", "parabola: mean, sd, px"),
        (
            (f"{fraction:.2f}", f"{own:+.3f}, {own_sd:.3f}", f"{mean:+.3f}, {sd:.3f}")
            for fraction in (0.0, 0.25, 0.5, 0.75)
            for own, own_sd, mean, sd in (stereo_errors_px(fraction),)
        ),
    )
    yield (
        ("stereo: read noise, 1/z", "noise by the formula, mm", "matching, mm", "both, mm", "measured, mm", "ratio"),
        (
            (
                f"{read:g}, {inverse:g}",
                f"{noise:.2f}",
                f"{matching:.2f}",
                f"{both:.2f}",
                f"{found:.2f}",
                f"{found / both:.2f}",
            )
            for read in (100.0, 40.0, 7.0)
            for inverse in (0.2, 0.31, 0.45)
            for noise, matching, found in (stereo_depth_error_mm(read, inverse),)
            for both in (math.hypot(noise, matching),)
        ),
    )
