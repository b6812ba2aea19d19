"""The simulated apparatus: a camera in front of the world's scene, and a light source that shows given patterns.

It has the members of `rig.strategies.apparatus.Apparatus`. Calls follow each other on its own clock, which begins at 0,
and every exposure begins when the one before it ends. Counts and noise are drawn from one generator of a given seed.

A source of power P shows a pattern with relative brightness b_c in column c. The column gets, in watts,

    rule "energy":       P b_c / (sum over columns of b)          the whole power, whatever is lit
    rule "irradiance":   P b_c / (columns / 2)                    as bright as P spread over half of the columns

If the patterns of rows differ, the sum is averaged over the rows. A column is a whole line over the fan's angle. A spot
is the part of a line in one row. Under the rule "energy" it has the power of the whole line, so it is brighter than the
line by the number of rows over which the fan spreads. Under the rule "irradiance" it is as bright as the line.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.interfaces import PulseTimes, Rule, Spent
from sim_backend.effects.setting import Array, Setting
from sim_backend.frames.flux import FluxModel
from sim_backend.projector.draws import SensorBits, add_counts, readings
from sim_backend.projector.hardware import ConventionalCamera, PulsedSource
from sim_backend.projector.pulse import blur_s, echoes, first_photons, gate
from sim_backend.projector.stereo import ambient_radiance, first_view, second_view
from sim_backend.projector.transport import Float32, Moment, Transport, blocks

Counts = NDArray[np.uint32]

MOST_FRAMES = 2**32 - 1
MOST_POWER_W = 1e6
SPOTS_AT_ONCE = 4096
DARK = "dark counts"
"""Name of the effect without the source that only the SPAD has, not the conventional camera."""
MULTIPLE = "halo"
"""Name of the effect of light that is scattered more than once."""


@dataclass(frozen=True, slots=True)
class Hardware:
    """Settings of the hardware for ways of measuring depth without a scanned line."""

    camera: ConventionalCamera
    pulses: PulsedSource


@dataclass(frozen=True, slots=True, eq=False)
class Request:
    """The request for an apparatus.

    power_w: power of the source. rule: how light is shared. seed: of all random draws. depth_range_m: nearest and
    farthest depth, which decides the gate of the pulsed source. frame_s: time of a frame of the SPAD.

    Raises ValueError for impossible values.
    """

    power_w: float
    rule: Rule
    seed: int
    depth_range_m: tuple[float, float]
    frame_s: float

    def __post_init__(self) -> None:
        near_m, far_m = self.depth_range_m
        if not 0 <= self.power_w <= MOST_POWER_W:
            raise ValueError(f"power_w is {self.power_w:g}; give a power of 0 to {MOST_POWER_W:g} W")
        if self.rule not in ("energy", "irradiance"):
            raise ValueError(f"rule is {self.rule!r}; write energy or irradiance")
        if not 0 < near_m < far_m < np.inf:
            raise ValueError(f"depth_range_m is {near_m:g} to {far_m:g} m; give two depths above 0 m, the nearer first")
        if not 0 < self.frame_s < np.inf:
            raise ValueError(f"spad_frame_s is {self.frame_s:g} s; give a time above 0 s")


class SimulatedApparatus:
    """One camera, one light source, one scene. Call its methods from one thread only: they share a random generator."""

    def __init__(self, transport: Transport, flux: FluxModel, hardware: Hardware, request: Request) -> None:
        """flux: the effects that the transport was computed with."""
        camera, setting, rows = hardware.camera, flux.setting, transport.rows
        self.rows: NDArray[np.int64] = rows
        """Image rows that are measured, ascending."""
        self.columns: int = transport.light.shape[1]
        self.width: int = transport.light.shape[2]
        self.spad_frame_s = request.frame_s
        self.camera_frame_s = 1 / camera.frame_rate
        self.camera_full_scale = 2**camera.bits - 1
        self.pulse_sigma_s = blur_s(hardware.pulses)
        self._transport, self._hardware, self._request = transport, hardware, request
        self._bits = SensorBits(flux, rows, request.frame_s)
        self._electrons = camera.quantum_efficiency * camera.fill_factor
        self._electrons /= setting.sensor.detection_probability * setting.sensor.fill_factor
        light = [rate[rows] for name, rate in flux.steady.items() if name != DARK]
        self._light_per_s = sum(light, np.zeros_like(transport.steady_per_s))
        self._setting, self._multiple = setting, MULTIPLE in flux.laser
        self._rows_of_fan = rows_of_fan(setting)[rows]
        self._rng = np.random.default_rng(request.seed)
        self._time_s = self._energy_j = 0.0

    @property
    def spent(self) -> Spent:
        """Time and energy of all calls since the apparatus was made."""
        return Spent(self._time_s, self._energy_j)

    def spad_counts(self, patterns: ArrayLike, frames: ArrayLike) -> Counts:
        """Show patterns one after the other, each for some frames of the SPAD, and count the frames in which each pixel
        fired: uint32 (patterns, rows, width).

        patterns: (patterns, columns), or (patterns, rows, columns) where rows differ; relative brightness, 0 to 1.
        frames: (patterns,), at least 1. Raises ValueError for other ones.
        """
        shown = self._checked(patterns)
        number = _frames(frames, len(shown))
        watts, lit_w = self._watts(shown)
        lasts_s = np.asarray(number * self.spad_frame_s, np.float64)
        moments, of_moment = self._when(lasts_s)
        turns = [
            (moment, np.flatnonzero(turn), turn)
            for moment, turn in zip(moments, _whole(of_moment, number), strict=True)
        ]
        counts = np.zeros((len(shown), len(self.rows), self.width), np.uint32)
        for part, of_part, light in self._lit(watts):
            steady_per_s = self._transport.steady_per_s[part, None]
            for moment, some, turn in turns:
                of_turn = self._transport.at_moment(light[:, some], of_part[:, some], part, moment)
                seen = self._bits.flux(self.spad_frame_s * (steady_per_s + of_turn), part)
                add_counts(self._rng, turn[some], seen, some, counts[:, part])
        self._spend(lasts_s, lit_w)
        return counts

    def camera_images(self, patterns: ArrayLike, exposure_s: float) -> NDArray[np.uint16]:
        """Show patterns one after the other, each for one exposure of the conventional camera: uint16 (patterns, rows,
        width), 0 to `camera_full_scale`.

        patterns: as in `spad_counts`. Raises ValueError for other ones, and for an exposure shorter than
        `camera_frame_s`.
        """
        shown = self._checked(patterns)
        self._check_exposure(exposure_s)
        watts, lit_w = self._watts(shown)
        lasts_s = np.full(len(shown), exposure_s)
        moments, shares = self._when(lasts_s)
        images = np.zeros((len(shown), len(self.rows), self.width), np.uint16)
        for part, of_part, light in self._lit(watts):
            mean = np.zeros(light.shape)
            for moment, share in zip(moments, shares, strict=True):
                some = np.flatnonzero(share)
                of_moment = self._transport.at_moment(light[:, some], of_part[:, some], part, moment)
                mean[:, some] += share[some, None] * of_moment
            per_s = self._electrons * (self._light_per_s[part, None] + mean) + self._hardware.camera.dark_current
            images[:, part] = readings(self._rng, exposure_s * per_s, self._hardware.camera).swapaxes(0, 1)
        self._spend(lasts_s, lit_w)
        return images

    def spots(self, rows: ArrayLike, columns: ArrayLike, frames: int, brightness: float = 1.0) -> Counts:
        """Light single spots one after the other, each for some frames of the SPAD. Returns uint32 (spots, width), the
        counts of each spot's own row.

        rows: (spots,) indices into `rows`; columns: (spots,). brightness: relative, 1 for the full power or irradiance.
        Light that a spot scatters into other rows is not in the result. Raises ValueError for spots outside the
        picture, and for a brightness that is not above 0 or is above 1.
        """
        if not 0 < brightness <= 1:
            raise ValueError(f"brightness of spots is {brightness:g}; it is above 0 and at most 1")
        at_row, at_column = _indices("rows", rows, len(self.rows)), _indices("columns", columns, self.columns)
        if at_row.shape != at_column.shape:
            raise ValueError(f"spots have {len(at_row)} rows and {len(at_column)} columns; give one of each for a spot")
        number = _frames(np.full(len(at_row), frames), len(at_row))
        spread = self._rows_of_fan[at_row]
        power_w, lit_w = self._request.power_w * spread, np.full(len(at_row), self._request.power_w)
        if self._request.rule == "irradiance":
            power_w, lit_w = (np.full(len(at_row), self._column_w), self._column_w / spread)
        power_w, lit_w = brightness * power_w, brightness * lit_w
        lasts_s = np.asarray(number * self.spad_frame_s, np.float64)
        moments, of_moment = self._when(lasts_s)
        counts = np.zeros((len(at_row), 1, self.width), np.uint32)
        for moment, turn in zip(moments, _whole(of_moment, number), strict=True):
            of_turn = np.flatnonzero(turn)
            for some in np.split(of_turn, range(SPOTS_AT_ONCE, len(of_turn), SPOTS_AT_ONCE)):
                light = power_w[some, None] * self._transport.of_spots(at_row[some], at_column[some], moment)
                flux = self.spad_frame_s * (self._transport.steady_per_s[at_row[some]] + light)
                seen = self._bits.flux(flux[:, None], at_row[some])
                add_counts(self._rng, turn[some], seen.swapaxes(0, 1), some, counts)
        self._spend(lasts_s, lit_w)
        return counts[:, 0]

    def pulse_times(self, pulses: int, bin_s: float) -> PulseTimes:
        """Light the whole picture with short pulses, one per frame of the SPAD, and time the first photon that each
        pixel detects after each pulse (see `sim_backend.projector.pulse`).

        Raises ValueError for less than one pulse, for bins that are not above 0 s or are longer than the gate, and if
        the counts would need too much memory.
        """
        (number,) = _frames(np.array([pulses]), 1).tolist()
        power_w = self._request.power_w * (2 if self._request.rule == "irradiance" else 1)
        back = echoes(self._setting, self.rows, self._transport.steady_per_s, self._multiple)
        opened = gate(self._hardware.pulses, self._request.depth_range_m, back.stretch, bin_s)
        counts = first_photons(self._rng, back, opened, number, power_w * self.spad_frame_s, self._bits)
        self._spend(np.array([number * self.spad_frame_s]), np.array([power_w]))
        return PulseTimes(counts, opened.start_s, bin_s, number)

    def stereo_pair(self, exposure_s: float) -> NDArray[np.uint16]:
        """Take one image with each of two conventional cameras, in ambient light only: uint16 (2, rows, width).

        Both are without the narrow filter. The second one stands beside the first, as far left or right as the point
        where light leaves the mirror (see `sim_backend.projector.stereo`). Raises ValueError for an exposure shorter
        than `camera_frame_s`.
        """
        self._check_exposure(exposure_s)
        camera, setting = self._hardware.camera, self._setting
        views = first_view(setting.view, self.rows), second_view(setting.view, self.rows)
        radiance = np.stack([ambient_radiance(setting, seen, camera.broad_filter) for seen in views])
        per_s = self._electrons * setting.gain * radiance + camera.dark_current
        images = readings(self._rng, exposure_s * per_s, camera)
        self._spend(np.array([exposure_s]), np.zeros(1))
        return images

    @property
    def _column_w(self) -> float:
        """Power of a lit column under the rule of equal irradiance."""
        return self._request.power_w / (self.columns / 2)

    def _checked(self, patterns: ArrayLike) -> Float32:
        shown = np.asarray(patterns, np.float32)
        shapes = (self.columns,), (len(self.rows), self.columns)
        if shown.shape[1:] not in shapes or not len(shown):
            raise ValueError(
                f"patterns have shape {shown.shape}; give (patterns, {self.columns}) or "
                f"(patterns, {len(self.rows)}, {self.columns}), with at least one pattern"
            )
        if not (shown.min() >= 0 and shown.max() <= 1):  # also if one is NaN
            raise ValueError(f"patterns go from {shown.min():g} to {shown.max():g}; a brightness is 0 to 1")
        return shown

    def _check_exposure(self, exposure_s: float) -> None:
        if not self.camera_frame_s <= exposure_s < np.inf:
            raise ValueError(
                f"exposure_s is {exposure_s:g} s; the conventional camera takes at least {self.camera_frame_s:g} s"
            )

    def _watts(self, shown: Float32) -> tuple[Float32, Array]:
        """Watts in each column of the patterns, and watts that leave the source in each pattern (patterns,)."""
        of_row = shown.sum(axis=-1, dtype=np.float64)
        total = of_row if of_row.ndim == 1 else of_row.mean(axis=1)
        if self._request.rule == "irradiance":
            return np.float32(self._column_w) * shown, self._column_w * total
        lit = total > 0
        scale = np.divide(self._request.power_w, total, out=np.zeros_like(total), where=lit)
        watts = shown * scale.reshape(-1, *[1] * (shown.ndim - 1))
        return watts.astype(np.float32), self._request.power_w * lit

    def _when(self, lasts_s: Array) -> tuple[list[Moment | None], Array]:
        """Moments and shares (`Transport.moments`) of exposures that follow each other from now on."""
        return self._transport.moments(self._time_s, self._time_s + np.cumsum(lasts_s))

    def _lit(self, watts: Float32) -> Iterator[tuple[slice, Float32, Float32]]:
        """Blocks of rows; watts (rows or 1, patterns, columns) and the light in them (rows, patterns, width)."""
        for part in blocks(len(self.rows), len(watts), self.width):
            by_row = np.ascontiguousarray(watts[:, part].swapaxes(0, 1)) if watts.ndim == 3 else watts[None]
            yield part, by_row, self._transport.of_patterns(by_row, part)

    def _spend(self, lasts_s: Array, lit_w: Array) -> None:
        self._time_s += float(lasts_s.sum())
        self._energy_j += float(lasts_s @ lit_w)


def rows_of_fan(setting: Setting) -> Array:
    """For each row, the height of the line's fan divided by the height of the row, float64 (rows,)."""
    view = setting.view
    tangent = view.v[:, view.width // 2]
    return np.asarray(setting.line.fan * (1 + tangent**2) / np.abs(np.gradient(tangent)))


def _whole(shares: Array, frames: NDArray[np.int64]) -> NDArray[np.int64]:
    """Whole frames in these shares (moments, patterns) of frames (patterns,), which they add up to."""
    until = np.rint(np.cumsum(shares, axis=0) * frames).astype(np.int64)
    return np.diff(until, axis=0, prepend=0)


def _frames(frames: ArrayLike, patterns: int) -> NDArray[np.int64]:
    number = np.asarray(frames)
    if number.shape != (patterns,) or not np.issubdtype(number.dtype, np.integer):
        raise ValueError(f"frames are {number.dtype} of shape {number.shape}; give {patterns} whole numbers")
    if patterns and not (number.min() >= 1 and number.max() <= MOST_FRAMES):
        raise ValueError(f"frames go from {number.min()} to {number.max()}; each is 1 to {MOST_FRAMES}")
    return number.astype(np.int64)


def _indices(name: str, given: ArrayLike, number: int) -> NDArray[np.int64]:
    at = np.asarray(given)
    if at.ndim != 1 or not len(at) or not np.issubdtype(at.dtype, np.integer):
        raise ValueError(f"{name} of spots are {at.dtype} of shape {at.shape}; give a list of whole numbers")
    if at.min() < 0 or at.max() >= number:
        raise ValueError(f"{name} of spots go from {at.min()} to {at.max()}; they are 0 to {number - 1}")
    return at.astype(np.int64)
