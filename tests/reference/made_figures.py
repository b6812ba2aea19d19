"""Figures that only a made scene can tell: sub-pixel place over its bound, thin objects, a second return."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.reference.answers import OUTLIER_PX, WITHIN_PX, averaged_pixels
from tests.reference.made_scenes import thin_scene
from tests.reference.working_point import WorkingPoint, at_stripe

LAGS = 24
"""Pixels over which errors of neighbouring answers are looked at for being averages of the same light."""
SURE = 0.5


def figures_of(point: str, world: WorkingPoint, stripe: Any, exposures: int) -> dict[str, float]:
    """Figures by name of one StripeTable; none for a point on prepared scenes."""
    if point == "smooth":
        return _bound(world, stripe, exposures)
    if point == "thin":
        return _thin(world, stripe)
    return _second(world, stripe) if point == "pane" else {}


def _bound(world: WorkingPoint, stripe: Any, exposures: int) -> dict[str, float]:
    """Errors over the Cramer-Rao bound of as many pixels as an answer averages, as its errors' correlation tells."""
    error = stripe.x_px.astype(np.float64) - world.x_true
    error[~world.trusted] = np.nan
    kept = np.where(np.abs(error) <= OUTLIER_PX, error, np.nan)
    rms = float(np.sqrt(np.nanmean(kept**2)))
    pixels = averaged_pixels(kept, LAGS)
    alone = world.sub_pixel_sd(exposures, slice(None, None, 16))
    bound = float(np.sqrt(1 / np.mean(1 / alone[np.isfinite(alone)] ** 2)))
    return {
        "rms error, px": rms,
        "bias, px": float(np.nanmean(kept)),
        "bound of one pixel, px": bound,
        "pixels averaged": pixels,
        "error in times the bound of them": rms * np.sqrt(pixels) / bound,
        "share off by more than 3 px": float(np.mean(np.abs(error[np.isfinite(error)]) > OUTLIER_PX)),
    }


def _thin(world: WorkingPoint, stripe: Any) -> dict[str, float]:
    """Share of the stripes on each thin object, and of all others, that were found."""
    _, masks = thin_scene(*world.scene.shape)
    right = np.abs(stripe.x_px - world.x_true) <= WITHIN_PX
    on = {name: at_stripe(mask, world.x_true) for name, mask in masks.items()}
    on["rest"] = np.isfinite(world.x_true) & ~on["pole"] & ~on["fence"]
    return {f"{name} within 1 px": float(right[there].mean()) for name, there in on.items()}


def _second(world: WorkingPoint, stripe: Any) -> dict[str, float]:
    """How often both surfaces are found where there are two, and how often a second one is where there is none."""
    x = np.stack([stripe.x_px, getattr(stripe, "x2_px", np.full_like(stripe.x_px, np.nan))])
    two = np.isfinite(world.x_second) & np.isfinite(world.x_true)
    one = np.isfinite(world.x_true) & ~two & world.trusted
    near = np.nanmin(np.abs(np.where(np.isfinite(x), x, np.inf) - world.x_second), axis=0) <= WITHIN_PX
    far = np.nanmin(np.abs(np.where(np.isfinite(x), x, np.inf) - world.x_true), axis=0) <= WITHIN_PX
    sure = np.isfinite(x[1]) & (getattr(stripe, "confidence2", np.zeros_like(x[0])) > SURE)
    return {
        "first or second return within 1 px of either": float((near | far)[two].mean()),
        "both returns within 1 px": float((near & far)[two].mean()),
        "sure of a second return where there is one": float(sure[two].mean()),
        "sure of a second return where there is none": float(sure[one].mean()),
    }
