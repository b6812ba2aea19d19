"""Figures that a mean over stripes does not tell: sub-pixel place over its bound, thin objects, second return, fog."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tests.reference.made_scenes import thin_scene
from tests.reference.tables.answers import MISSING_PX, OUTLIER_PX, WITHIN_PX, averaged_pixels
from tests.reference.working_point import WorkingPoint, at_stripe

LAGS = 24
"""Pixels over which errors of neighbouring answers are looked at for being averages of the same light."""
SURE = 0.5
MUCH_FOG = 1.25
"""Optical depth; halo and stripe of the point `halo` are made for 1 at the scene's median depth."""


def figures_of(point: str, world: WorkingPoint, stripes: Sequence[Any], exposures: int) -> dict[str, float]:
    """Figures by name of the StripeTables of one map, or two where noise is asked for; none for most points."""
    if point == "smooth":
        return _bound(world, stripes, exposures)
    if point == "thin":
        return _thin(world, stripes[0])
    if point == "halo":
        return _through_fog(world, stripes[0])
    return _second(world, stripes[0]) if point == "pane" else {}


def _through_fog(world: WorkingPoint, stripe: Any) -> dict[str, float]:
    """Mean error of trusted stripes behind little and behind much fog."""
    error = np.abs(stripe.x_px - world.x_true)
    error = np.where(np.isfinite(error), error, MISSING_PX)
    thin = world.optical_depth <= MUCH_FOG
    parts = {f"mean error to optical depth {MUCH_FOG:g}": thin, f"mean error beyond {MUCH_FOG:g}": ~thin}
    return {name: float(error[world.trusted & part].mean()) for name, part in parts.items()}


def _bound(world: WorkingPoint, stripes: Sequence[Any], exposures: int) -> dict[str, float]:
    """Errors over the Cramer-Rao bound of as many pixels as an answer averages.

    How many those are is told by how the noise of neighbours is correlated; noise is half the difference of two maps.
    """
    errors = [np.where(world.trusted, stripe.x_px.astype(np.float64) - world.x_true, np.nan) for stripe in stripes[:2]]
    kept = np.stack([np.where(np.abs(error) <= OUTLIER_PX, error, np.nan) for error in errors])
    rms = float(np.sqrt(np.nanmean(kept**2)))
    pixels = averaged_pixels((kept[0] - kept[1]) / np.sqrt(2), LAGS)
    alone = world.sub_pixel_sd(exposures, slice(None, None, 16))
    bound = float(np.sqrt(1 / np.mean(1 / alone[np.isfinite(alone)] ** 2)))
    lost = np.abs(errors[0][np.isfinite(errors[0])]) > OUTLIER_PX
    return {
        "rms error, px": rms,
        "of it noise, px": float(np.nanstd(kept[0] - kept[1]) / np.sqrt(2)),
        "bias, px": float(np.nanmean(kept)),
        "bound of one pixel, px": bound,
        "pixels averaged": pixels,
        "error in times the bound of them": rms * np.sqrt(pixels) / bound,
        "share off by more than 3 px": float(np.mean(lost)),
    }


def _thin(world: WorkingPoint, stripe: Any) -> dict[str, float]:
    """Share of the stripes on each thin object, and of all others, that were found."""
    _, masks = thin_scene(*world.scene.shape)
    right = np.abs(stripe.x_px - world.x_true) <= WITHIN_PX
    on = {name: at_stripe(mask, world.x_true) for name, mask in masks.items()}
    on["rest"] = np.isfinite(world.x_true) & ~on["pole"] & ~on["fence"]
    return {f"{name} within 1 px": float(right[there].mean()) for name, there in on.items()}


def _second(world: WorkingPoint, stripe: Any) -> dict[str, float]:
    """Shares of places with two surfaces where both are found, and of others where a second one is."""
    x = np.stack([stripe.x_px, getattr(stripe, "x2_px", np.full_like(stripe.x_px, np.nan))])
    two = np.asarray(np.isfinite(world.x_second) & np.isfinite(world.x_true))
    one = np.isfinite(world.x_true) & ~two & world.trusted
    near = np.asarray((np.abs(x - world.x_second) <= WITHIN_PX).any(axis=0))
    far = np.asarray((np.abs(x - world.x_true) <= WITHIN_PX).any(axis=0))
    sure = np.isfinite(x[1]) & (getattr(stripe, "confidence2", np.zeros_like(x[0])) > SURE)
    return {
        "a return within 1 px of either": float((near | far)[two].mean()),
        "both returns within 1 px": float((near & far)[two].mean()),
        "sure of a second return where there is one": float(sure[two].mean()),
        "sure of a second return where there is none": float(sure[one].mean()),
    }
