"""Laser class of a source of visible light: how much of it may enter an eye, by IEC 60825-1:2014 (third edition).

Accessible emission limits through a pupil of 7 mm at 100 mm (measurement condition 3), for 400 to 700 nm. Every source
counts as small (C6 = 1), which the standard's simplified evaluation allows and which never gives a lower class. t is a
duration in s.

    class 1, heat       3.8e-8 J             t < 10 ps          C3 = 1 up to 450 nm, then 10^(0.02 (nm - 450))
                        7.7e-8 J             t < 5 us
                        7e-4 t^0.75 J        t < 10 s
                        3.9e-4 W             above
    class 1, blue light 3.9e-3 C3 J          10 s <= t < 100 s  (400 to 600 nm)
                        3.9e-5 C3 W          above
    class 2             1e-3 W               t >= 0.25 s; shorter: as class 1
    class 3R            5 times class 1 below 0.25 s, 5e-3 W above
    class 3B            0.03 J               t < 0.06 s
                        0.5 W                above

Time bases: 100 s for class 1, 0.25 s for the others. Pulses must meet three rules. Each pulse must keep the limit for
its own duration. All pulses within the time base together must keep the limit for that time. And each pulse must keep
its limit times C5, where C5 = 5 N^-0.25 (at least 0.4) if N > 600 pulses of at most 5 us fall into a time base above
0.25 s, and 1 otherwise. Pulses closer than 5 us count as one of 5 us. The limits for heat are the exposure limits of
ICNIRP ("Guidelines on limits of exposure to laser radiation of wavelengths between 180 nm and 1,000 um", Health Physics
105, 2013) times the pupil's area: 18 t^0.75 J/m2, 2e-3 J/m2 and 10 W/m2. This is arithmetic for comparing sources, no
classification of a product; see docs/explanation/laser-safety.md.
"""

import math
from dataclasses import dataclass
from typing import Final, Literal

LaserClass = Literal["1", "2", "3R", "3B", "4"]
CLASSES: Final[tuple[Literal["1", "2", "3R", "3B"], ...]] = ("1", "2", "3R", "3B")
TIME_BASE_S: Final = {"1": 100.0, "2": 0.25, "3R": 0.25, "3B": 0.25}
PUPIL_M: Final = 7e-3
DISTANCE_M: Final = 0.1
PUPIL_RAD: Final = PUPIL_M / DISTANCE_M
"""Angle over which light enters the pupil, from a source that spreads it."""
GROUPED_S: Final = 5e-6
"""Pulses within this time count as one; T_i of the standard for 400 to 1050 nm."""
BLUE_TO_M: Final = 600e-9
VISIBLE_M: Final = (400e-9, 700e-9)


@dataclass(frozen=True, slots=True)
class Beam:
    """Light that enters a pupil at 100 mm. power_w: power while it enters. pulse_s: how long it enters at a time.
    rate_hz: how often. If it enters all the time, pulse_s is infinite and rate_hz is not used."""

    power_w: float
    pulse_s: float = math.inf
    rate_hz: float = 1.0

    @property
    def mean_w(self) -> float:
        """Mean power over a long time."""
        return self.power_w * min(1.0, self.pulse_s * self.rate_hz)


def limit_j(laser_class: Literal["1", "2", "3R", "3B"], duration_s: float, wavelength_m: float) -> float:
    """Accessible emission limit of a class: the most energy in J within `duration_s`, 1 ps to 30 000 s.

    Raises ValueError for light that is not visible and for other durations.
    """
    if not VISIBLE_M[0] <= wavelength_m <= VISIBLE_M[1]:
        raise ValueError(f"wavelength is {wavelength_m * 1e9:g} nm; limits are known here for 400 to 700 nm")
    if not 1e-12 <= duration_s <= 3e4:
        raise ValueError(f"duration is {duration_s:g} s; limits hold for 1e-12 to 3e4 s")
    if laser_class == "3B":
        return 0.03 if duration_s < 0.06 else 0.5 * duration_s
    if laser_class != "1" and duration_s >= 0.25:
        return (1e-3 if laser_class == "2" else 5e-3) * duration_s
    class_1_j = _class_1_j(duration_s, wavelength_m)
    return 5.0 * class_1_j if laser_class == "3R" else class_1_j


def _class_1_j(duration_s: float, wavelength_m: float) -> float:
    if duration_s < 1e-11:
        return 3.8e-8
    if duration_s < GROUPED_S:
        return 7.7e-8
    if duration_s < 10:
        return 7e-4 * math.pow(duration_s, 0.75)
    heat_j = 3.9e-4 * duration_s
    if wavelength_m >= BLUE_TO_M:
        return heat_j
    c3 = math.pow(10.0, 0.02 * max(wavelength_m * 1e9 - 450, 0.0))
    return min(heat_j, 3.9e-3 * c3 if duration_s < 100 else 3.9e-5 * c3 * duration_s)


def class_of(beam: Beam, wavelength_m: float) -> LaserClass:
    """The lowest class whose limits a beam meets. Raises ValueError for light that is not visible, unless the beam has
    no power."""
    return next((each for each in CLASSES if _meets(beam, each, wavelength_m)), "4")


def _meets(beam: Beam, laser_class: Literal["1", "2", "3R", "3B"], wavelength_m: float) -> bool:
    base_s = TIME_BASE_S[laser_class]
    if beam.power_w <= 0:
        return True
    steady = limit_j(laser_class, base_s, wavelength_m)
    if beam.pulse_s >= base_s:
        return beam.power_w * base_s <= steady
    pulse_s, rate_hz = beam.pulse_s, beam.rate_hz
    energy_j = beam.power_w * pulse_s
    if rate_hz > 1 / GROUPED_S:
        energy_j, pulse_s, rate_hz = energy_j * rate_hz * GROUPED_S, GROUPED_S, 1 / GROUPED_S
    pulses = base_s * rate_hz
    single_j = limit_j(laser_class, max(pulse_s, 1e-12), wavelength_m)
    train = max(5 * pulses**-0.25, 0.4) if pulse_s <= GROUPED_S and base_s > 0.25 and pulses > 600 else 1.0
    return energy_j <= single_j * min(train, 1.0) and beam.mean_w * base_s <= steady


@dataclass(frozen=True, slots=True)
class Field:
    """The field that a source lights: angles in rad along the line (fan) and across it (scan), and its power in W."""

    power_w: float
    fan_rad: float
    scan_rad: float

    @property
    def along(self) -> float:
        """Share of a line that enters a pupil."""
        return min(1.0, PUPIL_RAD / self.fan_rad)

    @property
    def across(self) -> float:
        """Share of the scan during which a line is on a pupil."""
        return min(1.0, PUPIL_RAD / self.scan_rad)

    @property
    def of_picture(self) -> float:
        """Share of an evenly lit picture that enters a round pupil."""
        return min(1.0, math.pi / 4 * PUPIL_RAD**2 / (self.fan_rad * self.scan_rad))

    def spot(self, map_s: float, rows: int) -> tuple[Beam, Beam]:
        """Beams of a spot that scans `rows` rows in `map_s`, again and again, and of one that stands still."""
        passes = max(1.0, rows * self.along)
        return Beam(self.power_w, map_s / rows * self.across, passes / map_s), Beam(self.power_w)

    def line(self, map_s: float) -> tuple[Beam, Beam]:
        """Beams of a line that scans the field in `map_s`, again and again, and of one that stands still."""
        power_w = self.power_w * self.along
        return Beam(power_w, map_s * self.across, 1 / map_s), Beam(power_w)

    def pattern(self) -> tuple[Beam, Beam]:
        """Beam of a projector's picture with half of its columns lit, for a pupil that lies in lit columns only. It is
        returned twice, since it does not scan."""
        beam = Beam(min(2 * self.of_picture, 1.0) * self.power_w)
        return beam, beam

    def flash(self, pulse_s: float, rate_hz: float) -> tuple[Beam, Beam]:
        """Beam of short pulses that light the whole field. It is returned twice, since it does not scan."""
        beam = Beam(self.of_picture * self.power_w / (pulse_s * rate_hz), pulse_s, rate_hz)
        return beam, beam
