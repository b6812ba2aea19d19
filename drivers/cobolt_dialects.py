"""The two languages of Cobolt 06-01 lasers for the same few things: gate mode, power, dark, bright.

hardware.md section 4.1 (cobolt-lasers/pycobolt 1333e53). Both keep the laser dark by a power of 0 and not by `l0`:
after `l0` its key must be turned (pycobolt issue 6), and a power of 0 can be read back, by the next program too.
"""

import re
from typing import Protocol

from drivers.cobolt_framing import COUNT, WORD
from drivers.dialogue import FLAG, NUMBER, Dialogue

_POWER_STEP_W = 1e-4
"""The finest power that every model keeps: 0.1 mW."""


class Dialect(Protocol):
    """What the driver needs said. All methods raise the errors of `Dialogue`."""

    family: str

    def mode(self) -> str:
        """The mode as the laser calls it."""
        ...

    def input_mode(self, mode: str) -> str:
        """What governs the light in it: "digital" under the gate; everything else shines without asking the gate."""
        ...

    def gate(self) -> None:
        """Let the TTL input, and nothing else, govern the light. Read back; to be called in the dark."""
        ...

    def set_power(self, power_w: float) -> None:
        """Power while the gate is high. Read back."""
        ...

    def power_w(self, mode: str) -> float | None:
        """The power that the laser is set to in this mode. None: set by current, it cannot say."""
        ...

    def darken(self) -> None:
        """No light in any mode that knows a power, at once and without the key."""
        ...

    def brighten(self) -> None:
        """End what `darken` did besides the power."""
        ...

    def waits_for_key(self) -> bool:
        """It starts once its key is turned off and on."""
        ...


def classify(model: str) -> str:
    """The family that a model number means, as pycobolt sorts them: "06-01", "06-MLD", "06-DPL" or "unknown"."""
    if re.search(r"-06-(5|9).*-\d{3,4}(-C)?$", model):
        return "06-DPL"  # in either language its power follows a gate up to 1 kHz only
    if re.search(r"-06-.*-1\d{3}(-C)?$", model):
        return "06-01"
    if re.search(r"-06-0", model):
        return "06-MLD"
    return "unknown"


class MldDialect:
    """06-MLD: `slmp`, `sdmes`, `em`."""

    family = "06-MLD"
    _MODES = ("constant current", "constant power")

    def __init__(self, line: Dialogue) -> None:
        self._line = line

    def mode(self) -> str:
        """`gam?`: 0 constant current, 1 constant power, 2 modulation."""
        return self._line.ask("gam?", re.compile("[012]"))

    def input_mode(self, mode: str) -> str:
        """From `gdmes?` and `games?`."""
        if mode != "2":
            return self._MODES[int(mode)]
        return _inputs(self._line.ask_flag("gdmes?"), self._line.ask_flag("games?"))

    def gate(self) -> None:
        """Digital modulation on, analog off, modulation mode."""
        self._line.tell_and_check("sdmes 1", "gdmes?", FLAG, "1".__eq__)
        self._line.tell_and_check("sames 0", "games?", FLAG, "0".__eq__)
        self._line.tell_and_check("em", "gam?", COUNT, "2".__eq__)

    def set_power(self, power_w: float) -> None:
        """`slmp` takes milliwatts."""
        self._power_mw(power_w * 1e3)

    def power_w(self, mode: str) -> float | None:
        """`glmp?` in milliwatts, `p?` in watts."""
        if mode == "0":
            return None
        return self._line.ask_number("glmp?") * 1e-3 if mode == "2" else self._line.ask_number("p?")

    def darken(self) -> None:
        """The power of the present mode first: this may be an emergency."""
        self._power_mw(0.0)
        self._line.tell("p 0")

    def brighten(self) -> None:
        """Nothing besides the power."""

    def waits_for_key(self) -> bool:
        """`gom?` 1."""
        return self._line.ask("gom?", COUNT) == "1"

    def _power_mw(self, power_mw: float) -> None:
        self._line.tell_and_check(f"slmp {power_mw:.4f}", "glmp?", NUMBER, _near(power_mw))


class ScpiDialect:
    """The newer 06-01 language: `laser:runmode`, `las:paus`."""

    family = "06-01"
    _POWER = "laser:powermodulation:power:setpoint"

    def __init__(self, line: Dialogue) -> None:
        self._line = line

    def mode(self) -> str:
        """The run mode."""
        return self._line.ask("laser:runmode?", WORD).lower()

    def input_mode(self, mode: str) -> str:
        """From the inputs that are on."""
        if mode != "powermodulation":
            return mode
        return _inputs(self._line.ask_flag("las:pm:dig:ena?"), self._line.ask_flag("las:pm:ana:ena?"))

    def gate(self) -> None:
        """The modulator must be the external one: as "command" it follows `!e` and `!d` without ever replying."""
        self._line.tell_and_check("las:pm:dig:ena 1", "las:pm:dig:ena?", FLAG, "1".__eq__)
        self._line.tell_and_check("las:pm:ana:ena 0", "las:pm:ana:ena?", FLAG, "0".__eq__)
        self._line.tell("laser:pm:dig:modulator external")
        self._line.tell_and_check("laser:runmode PowerModulation", "laser:runmode?", WORD, _is_modulation)

    def set_power(self, power_w: float) -> None:
        """Milliwatts."""
        self._power_mw(power_w * 1e3)

    def power_w(self, mode: str) -> float | None:
        """Milliwatts in both modes that know a power."""
        if mode == "powermodulation":
            return self._line.ask_number(f"{self._POWER}?") * 1e-3
        return self._line.ask_number("laser:cp:power:setpoint?") * 1e-3 if mode == "constantpower" else None

    def darken(self) -> None:
        """`las:paus 1` blanks it at once; the powers of 0 tell the next program so."""
        self._line.tell("las:paus 1")
        self._power_mw(0.0)
        self._line.tell("laser:cp:power:setpoint 0")

    def brighten(self) -> None:
        """End the pause."""
        self._line.tell("las:paus 0")

    def waits_for_key(self) -> bool:
        """`state?` AutostartWaitingForKeyOn."""
        return "waitingforkey" in self._line.ask("state?", WORD).lower()

    def _power_mw(self, power_mw: float) -> None:
        self._line.tell_and_check(f"{self._POWER} {power_mw:.4f}", f"{self._POWER}?", NUMBER, _near(power_mw))


def _inputs(digital: bool, analog: bool) -> str:
    if digital and not analog:
        return "digital"
    return "mixed" if digital else "analog" if analog else "modulation without input"


class _near:  # noqa: N801 - reads as what it says
    """Whether a power read back in milliwatts is the one that was set."""

    def __init__(self, power_mw: float) -> None:
        self._power_mw = power_mw

    def __call__(self, reply: str) -> bool:
        return abs(float(reply) - self._power_mw) <= max(0.01 * self._power_mw, _POWER_STEP_W * 1e3 / 2)


def _is_modulation(reply: str) -> bool:
    return reply.lower() == "powermodulation"
