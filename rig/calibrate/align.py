"""Figures for setting a rig up, while it scans at low power: is the line seen, how wide is it, does it saturate?

`align` scans without a calibration and without a folder, sweep after sweep, until it is interrupted or its time is
over. It publishes what a scan publishes, so that the page of `rig view --live` shows the sum image, and these figures.

The width of the line (focus) is its full width at half maximum in pixels of the sensor. It comes from the
autocorrelation of the counts along a row, averaged over many rows and columns. No line has to be found for that, so it
works far out of focus and in little light: the noise of two pixels is independent, so it cancels at every lag but 0,
and lag 0 is not used. Hot pixels cancel too. A line of Gaussian shape has an autocorrelation wider by the square root
of 2. The width includes the pixel's own. Haze and saturation make the line seem wider.
"""

import math
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np

from drivers.units import parse_quantity
from rig.calibrate.capture import plain
from rig.config.models import RigConfig
from rig.config.overrides import SIMULATED, Config, configure, seed_problems
from rig.count.volume import Counter, CountVolume, FrameTally, SweepLayout
from rig.depth.reconstruct import MapResult, Reconstructor, map_geometry
from rig.devices.open import OpenRig, light_problems, open_rig
from rig.devices.prepare import prepare
from rig.errors import DevicesError, PlanError, UsageError
from rig.geometry.stripe_table import StripeTable
from rig.live.feed import Feed
from rig.recording.replay import ENDLESS
from rig.requests import AlignRequest
from rig.scan.acquisition import Acquisition, AcquisitionRequest
from rig.scan.monitor import Listeners, RunBegun
from rig.scan.pipeline import Overload
from rig.simd import Float64

LOW_POWER: Final = 0.1
"""Share of the laser's limit at which a rig is aligned if no power is given."""
SURE: Final = 0.9
"""Least confidence of a stripe that counts as seen."""
SATURATED: Final = 0.9
"""Rate of detection from which a pixel counts as saturated: 2.3 photons an exposure, of which it tells one."""
TELL_S: Final = 1.0
"""Time between two reports."""
LOOK_S: Final = 0.2
"""Least time between two sweeps that are looked at: each takes some 20 ms of a processor."""
MOST_PLACES: Final = 48
"""Rows and columns, each, whose counts the width is taken from."""
REACH_PX: Final = 48
"""Largest lag. Lags from the last quarter show the level without a line; a line up to 20 px wide is measured."""
LEAST_REACH_PX: Final = 8
MOST_FALL: Final = 4.0
"""Ratio of the autocorrelations at lags 0 and 1 of a line that is much narrower than a pixel: 2/3 to 1/6."""
SURELY_SD: Final = 8.0
"""A line stands out if the autocorrelation at lag 1 is so many standard deviations above the level without one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignFigures:
    """The figures of a sweep. Rates are detections per exposure of a pixel.

    sweeps: number of the sweep, from 1. power_w: power of the laser; limit_w: its largest allowed power.
    focus_px: width of the line, None if none stands out; left_px, middle_px, right_px: its width in each third of the
    image. line_seen: share of rows and columns with a sure stripe. peak_rate: median rate at the brightest pixel of
    these stripes; scan_peak_rate: the rate expected there with the power of a scan; saturated_fraction: share of these
    stripes whose brightest pixel has a rate of SATURATED or more. All three are None without a sure stripe.
    mean_rate: mean over all pixels. lost: number of frames lost so far.
    """

    sweeps: int
    power_w: float
    limit_w: float
    focus_px: float | None
    left_px: float | None
    middle_px: float | None
    right_px: float | None
    line_seen: float
    peak_rate: float | None
    scan_peak_rate: float | None
    saturated_fraction: float | None
    mean_rate: float
    lost: int = 0

    @property
    def line(self) -> str:
        """The figures in a line for people."""
        parts = zip(("left", "middle", "right"), (self.left_px, self.middle_px, self.right_px), strict=True)
        widths = ", ".join(f"{name} {'-' if width is None else f'{width:.2f}'}" for name, width in parts)
        said = [
            "no line stands out" if self.focus_px is None else f"line {self.focus_px:.2f} px wide ({widths})",
            f"seen at {self.line_seen:.0%}",
        ]
        if self.peak_rate is not None and self.saturated_fraction is not None and self.scan_peak_rate is not None:
            said += [
                f"peak rate {self.peak_rate:.2f}, in a scan {self.scan_peak_rate:.2f}",
                f"{self.saturated_fraction:.1%} saturated",
            ]
        said.append(f"mean rate {self.mean_rate:.2g}")
        return f"sweep {self.sweeps}: {', '.join(said)}" + (f", {self.lost} frames lost" if self.lost else "")


@dataclass(frozen=True, slots=True)
class Alignment:
    """Result of an alignment. name: name of the config. last: figures of the last sweep; None if there was no whole
    one."""

    name: str
    last: AlignFigures | None

    @property
    def found(self) -> bool:
        """Whether a line was seen in the last sweep."""
        return self.last is not None and self.last.focus_px is not None

    def as_json(self) -> dict[str, Any]:
        """The figures as plain values, with a verdict: 'line', 'no line' or 'aborted'."""
        verdict = "line" if self.found else "no line" if self.last is not None else "aborted"
        return {"config": self.name, "verdict": verdict, **({} if self.last is None else asdict(self.last))}


def align(
    config: Config = SIMULATED,
    request: AlignRequest | None = None,
    *,
    begun: Callable[[float, float], None] | None = None,
    tell: Callable[[AlignFigures], None] | None = None,
    **changes: Any,
) -> Alignment:
    """Scan again and again at low power and report how the line looks (`rig align`).

    request, changes: options, as an `AlignRequest` or by the names of its fields.
    begun: called before any light comes out, with the laser's power and its limit, both in watts.
    tell: called with the newest figures, once a second.

    Ends after `seconds` or with an interrupt, and then leaves the rig safe as a scan does. Raises UsageError for a
    request that cannot be met, DeviceError or DevicesError if devices fail.
    """
    request = replace(request or AlignRequest(), **changes)
    settings = plain(configure(config, scene=request.scene, exposures=request.exposures))
    problems = light_problems(settings, request.arm) + seed_problems(request.seed)
    if request.seconds is not None and not request.seconds > 0:
        problems.append(f"seconds is {request.seconds:g}; it must be above 0")
    if problems:
        raise UsageError.of(problems)
    for known in dict.fromkeys((None, settings.calibration)):
        try:
            # Whole frames, since nothing is known yet; where the link cannot carry them, the calibration's windows.
            with open_rig(settings.model_copy(update={"calibration": known}), seed=request.seed) as rig:
                return _aligned(rig, settings, request, begun, tell)
        except PlanError:
            if known == settings.calibration:
                raise
    raise AssertionError("the last calibration is the config's")


def low_power_w(rig: OpenRig, asked: str | None) -> float:
    """The laser's power for an alignment. asked: text such as '2 mW'; None: LOW_POWER times its limit, or its least
    power if that is more.

    Raises UsageError for a text that is no power, and for a power outside the laser's limits.
    """
    limits = rig.laser.limits
    if asked is None:
        return max(limits.min_power_w, LOW_POWER * limits.max_power_w)
    try:
        power_w = parse_quantity(asked, "power")
    except ValueError as error:
        raise UsageError(f"`power` {asked!r}: {error}") from None
    if not limits.min_power_w <= power_w <= limits.max_power_w:
        raise UsageError(
            f"`power` is {power_w * 1e3:g} mW; {rig.laser.name} may be given {limits.min_power_w * 1e3:g} to "
            f"{limits.max_power_w * 1e3:g} mW; choose a power within, or change the limit in the config"
        )
    return power_w


def _aligned(
    rig: OpenRig,
    settings: RigConfig,
    request: AlignRequest,
    begun: Callable[[float, float], None] | None,
    tell: Callable[[AlignFigures], None] | None,
) -> Alignment:
    limit_w, scan_w = rig.laser.limits.max_power_w, rig.config.scan.power
    power_w = low_power_w(rig, request.power)
    scan = rig.config.scan.model_copy(update={"power": power_w})
    rig = replace(rig, config=rig.config.model_copy(update={"scan": scan}))
    plan, timing = prepare(rig)
    geometry = map_geometry(rig.model, plan.commands, plan.depth_range_m, sensor=(plan.rows, plan.width))
    maker = _Maker(Reconstructor(rig.model, plan.commands, geometry, rig.config.estimate))
    if begun is not None:
        begun(power_w, limit_w)
    last: AlignFigures | None = None
    with Feed("align", settings.name) as feed:
        listeners = feed.listeners(Listeners())
        feed.begin(RunBegun(rig, plan, geometry, ENDLESS, None))
        # A sweep with gaps shows the line too.
        policy = Overload.ABORT if rig.spad.info.can_wait else Overload.DROP
        asked = AcquisitionRequest(maps=ENDLESS, policy=policy, listeners=listeners)
        acquisition = Acquisition(rig, plan, timing, maker, asked)
        begun_s, told_s = time.monotonic(), -math.inf
        try:
            with closing(acquisition.run()) as running:
                for found in running:
                    feed.show_map(found)
                    now_s, look = time.monotonic(), maker.look
                    if look is not None and (last is None or look.sweep != last.sweeps):
                        lost = acquisition.counters.lost
                        lost = acquisition.stages.dropped_frames if lost is None else lost
                        last = look.figures(power_w, limit_w, scan_w or limit_w, lost)
                        feed.show_figures(asdict(last), {"profile": look.profile})
                    if tell is not None and last is not None and now_s - told_s >= TELL_S:
                        told_s = now_s
                        tell(last)
                    if request.seconds is not None and now_s - begun_s >= request.seconds:
                        break
        except KeyboardInterrupt:  # its usual end
            pass
        if acquisition.trouble:
            raise DevicesError("\n".join(acquisition.trouble))
    return Alignment(settings.name, last)


@dataclass(frozen=True, slots=True, eq=False)
class LineLook:
    """The line in the counts of one sweep.

    sweep: its number, from 1. widths_px: widths of the line in the whole image and in its thirds, None where none
    stands out. line_seen, mean_rate: as in `AlignFigures`. peak_rates: float64 (n,), rates of the sure stripes'
    brightest pixels. profile: float64 (width,), detections per exposure and pixel at each x, mean over the sweep and
    the rows.
    """

    sweep: int
    widths_px: tuple[float | None, ...]
    line_seen: float
    peak_rates: Float64
    mean_rate: float
    profile: Float64

    @classmethod
    def of(cls, sweep: int, volume: CountVolume, stripe: StripeTable) -> "LineLook":
        """Look at the counts of a sweep and its stripes."""
        counts, frames = volume.counts, np.maximum(volume.n_frames, 1)
        sure = (stripe.confidence >= SURE) & (volume.n_frames > 0)
        rows, columns = np.nonzero(sure)
        peaks = np.rint(stripe.x_px[rows, columns]).astype(np.int64) - volume.x0[columns]
        rates = row_rates(volume)
        third = rates.shape[1] // 3
        parts = rates, rates[:, :third], rates[:, third:-third], rates[:, -third:]
        profile = volume.intensity().sum(axis=0) / (counts.shape[1] * float(frames.sum()))
        return cls(
            sweep,
            tuple(line_width_px(part) for part in parts),
            float(sure.mean()),
            counts[columns, rows, np.clip(peaks, 0, counts.shape[2] - 1)] / frames[columns],
            float(rates.mean()),
            profile,
        )

    def figures(self, power_w: float, limit_w: float, scan_w: float, lost: int) -> AlignFigures:
        """The figures of this sweep, which was taken at `power_w`. scan_w: power of a scan."""
        peak = float(np.median(self.peak_rates)) if self.peak_rates.size else None
        # In a scan, so many times more photons; p = 1 - exp(-photons).
        foreseen = None if peak is None else 1.0 - (1.0 - peak) ** (scan_w / power_w)
        whole, left, middle, right = self.widths_px
        return AlignFigures(
            sweeps=self.sweep,
            power_w=power_w,
            limit_w=limit_w,
            focus_px=whole,
            left_px=left,
            middle_px=middle,
            right_px=right,
            line_seen=self.line_seen,
            peak_rate=peak,
            scan_peak_rate=foreseen,
            saturated_fraction=float((self.peak_rates >= SATURATED).mean()) if self.peak_rates.size else None,
            mean_rate=self.mean_rate,
            lost=lost,
        )


def row_rates(volume: CountVolume) -> Float64:
    """Rates of detection along rows, float64 (n, width): up to MOST_PLACES columns and rows each, spread evenly."""
    columns, rows, window = volume.counts.shape
    some = np.linspace(0, columns - 1, min(columns, MOST_PLACES)).astype(int)
    at = np.linspace(0, rows - 1, min(rows, MOST_PLACES)).astype(int)
    rates = np.zeros((len(some), len(at), max(volume.width, int(volume.x0.max(initial=0)) + window)))
    for out, column in zip(rates, some.tolist(), strict=True):
        first = int(volume.x0[column])
        out[:, first : first + window] = volume.counts[column, at] / max(int(volume.n_frames[column]), 1)
    return rates[:, :, : volume.width].reshape(-1, volume.width)


def line_width_px(rates: Float64) -> float | None:
    """Full width at half maximum of the line in rows of rates (n, pixels), from their mean autocorrelation, in pixels.

    None if no line stands out, if it is wider than half of the lags, or if the rows are too short for a level.
    """
    pixels = rates.shape[1]
    reach = min(REACH_PX, pixels // 2)
    if reach < LEAST_REACH_PX:
        return None
    power = (np.abs(np.fft.rfft(rates, 2 * pixels, axis=1)) ** 2).mean(axis=0)
    lags = np.arange(reach + 1)
    correlation = np.fft.irfft(power)[: reach + 1] / (pixels - lags)
    without = correlation[3 * reach // 4 :]
    net = correlation - without.mean()
    if not net[1] > SURELY_SD * float(without.std()):
        return None
    # Lag 0 holds the photon noise. A Gaussian falls from 0 to 1 by the cube root of its fall from 1 to 2.
    net[0] = net[1] * min(max(net[1] / max(net[2], 1e-9 * net[1]), 1.0) ** (1 / 3), MOST_FALL)
    below = np.flatnonzero(net < net[0] / 2)
    if not below.size or below[0] > reach // 2:
        return None
    b = int(below[0])
    # Between two lags the logarithm of a Gaussian is linear in the square of the lag.
    high, low = math.log(net[b - 1]), math.log(max(net[b], 1e-6 * net[0]))
    share = (high - math.log(net[0] / 2)) / (high - low)
    half_px = math.sqrt((b - 1) ** 2 + share * (b**2 - (b - 1) ** 2))
    return 2 * half_px / math.sqrt(2)


class _Maker:
    """Makes maps, and looks at the line in one of them each LOOK_S. look: the newest."""

    def __init__(self, maker: Reconstructor) -> None:
        self._maker = maker
        self._maps, self._looked_s = 0, -math.inf
        self.look: LineLook | None = None

    def counter(self, layout: SweepLayout) -> Counter:
        return self._maker.counter(layout)

    def map(self, sweep: FrameTally) -> MapResult:
        result = self._maker.map(sweep)
        self._maps += 1
        if time.monotonic() - self._looked_s >= LOOK_S:
            assert isinstance(sweep, CountVolume), "what argmax has counted"
            self.look = LineLook.of(self._maps, sweep, result.stripe)
            self._looked_s = time.monotonic()
        return result
