"""Model of a Cobolt 06-01 laser's firmware: 06-MLD or the newer SCPI-like language, key, autostart, interlock, faults.

docs/reference/hardware.md (cobolt-lasers/pycobolt 1333e53). Commands end with CR, replies with CRLF. Traps kept: no
answer to a command sooner than 100 ms after the last reply, key needed after `l0`, `l1` refused while autostart is
enabled, powers in W (`p`) and mW (`slmp`), `ilk?` 1 = open, junk before replies, silent `!e` and `!d`.
"""

import re
from collections.abc import Callable
from typing import Literal

Family = Literal["06-MLD", "06-01"]
Mode = Literal["constant current", "constant power", "modulation"]

MODELS: dict[Family, str] = {"06-MLD": "0488-06-01-0100-100", "06-01": "0488-06-01-0100-1100"}
"""A model number of each family, as `glm?` gives it."""
ILLEGAL = "Syntax error: illegal command"
FORBIDDEN = re.compile(r"@cobas \S+|@cobasky.*|@cobasdr.*")
"""Commands that bypass key and autostart: a driver that sends one of them has failed its test."""
GAP_S = 0.09
"""Commands closer than this to the last reply get no answer (the manual's 100 ms with some tolerance)."""

_SHORT = {
    "laser": "las",
    "runmode": "runm",
    "powermodulation": "pm",
    "constantpower": "cp",
    "digital": "dig",
    "analog": "ana",
    "enable": "ena",
    "power": "pow",
    "setpoint": "setp",
    "pause": "paus",
}
_MODE_NUMBER: dict[Mode, str] = {"constant current": "0", "constant power": "1", "modulation": "2"}
_RUN_MODE_NAME: dict[Mode, str] = {
    "constant current": "ConstantCurrent",
    "constant power": "ConstantPower",
    "modulation": "PowerModulation",
}
_RUN_MODES = {name.lower(): mode for mode, name in _RUN_MODE_NAME.items()}


class CoboltModel:
    """The laser. Its attributes are the truth that tests look at; the driver sees only what it says.

    on_emission(emits, now_s) is called whenever power or emission change.
    """

    def __init__(
        self,
        family: Family = "06-MLD",
        *,
        model: str | None = None,
        serial: str = "16328",
        firmware: str = "4.1.3",
        autostart: bool = True,
        warm_up_s: float = 3.0,
        junk: bytes = b"",
        gap_s: float = GAP_S,
        on_emission: Callable[[bool, float], None] | None = None,
    ) -> None:
        self.family = family
        self.model = MODELS[family] if model is None else model
        self.serial = serial
        self.firmware = firmware
        self.max_power_w = 0.1
        self.autostart = autostart
        self.warm_up_s = warm_up_s
        self.junk = junk
        self.on_emission = on_emission
        self.key_on = True
        self.key_needed = False
        self.waiting_for_key = False
        self.interlock_open = False
        self.fault = 0
        self.on = False
        self.paused = False
        self.mode: Mode = "constant power"
        self.constant_power_w = 0.0
        self.modulation_power_w = 0.0
        self.current_ma = 0.0
        self.digital = False
        self.analog = False
        self.modulator = "external"
        self.forbidden: list[str] = []
        """Commands received that no driver may send."""
        self.commands: list[str] = []
        """All commands received."""
        self._gap_s = gap_s
        self._ready_at_s: float | None = None
        self._quiet_since_s = float("-inf")
        self._pending = b""
        self._shown: tuple[bool, float] = (False, 0.0)

    @property
    def gated(self) -> bool:
        """Whether the TTL input governs the light."""
        return self.mode == "modulation" and self.digital and self.modulator == "external"

    @property
    def power_w(self) -> float:
        """Light that comes out now, through an open gate where it is gated, in W."""
        if not self.on or self.paused or self.interlock_open or self.fault:
            return 0.0
        match self.mode:
            case "modulation":
                return self.modulation_power_w
            case "constant power":
                return self.constant_power_w
            case _:
                return self.max_power_w * min(1.0, self.current_ma / 100.0)

    @property
    def emitting(self) -> bool:
        """Whether the laser would shine through an open gate."""
        return self.power_w > 0

    def shine(self, power_w: float, *, gated: bool = True) -> None:
        """Put the laser on, as somebody before us may have left it."""
        self.on = True
        self.mode = "modulation" if gated else "constant power"
        self.digital = gated
        self.modulation_power_w = self.constant_power_w = power_w

    def turn_key(self, on: bool, now_s: float) -> None:
        """A hand at the key."""
        self.key_on = on
        if not on:
            self._stop()
            self.waiting_for_key = self.autostart
        else:
            self.key_needed = False
            if self.waiting_for_key:
                self.waiting_for_key = False
                self._ready_at_s = now_s + self.warm_up_s
        self._tell(now_s)

    def open_interlock(self, now_s: float) -> None:
        """Open a door: the laser goes off, and fault 3 stays until it is cleared."""
        self.interlock_open = True
        self.fault = 3
        self._stop()
        self._tell(now_s)

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Commands in, replies out."""
        self.tick(now_s)
        self._pending += data
        out = b""
        while (end := self._pending.find(b"\r")) >= 0:
            command = self._pending[:end].decode("ascii", "replace").strip()
            self._pending = self._pending[end + 1 :]
            out += self._reply(command, now_s)
        return out

    def tick(self, now_s: float) -> bytes:
        """Warm-up ends; the laser never speaks unasked."""
        if self._ready_at_s is not None and now_s >= self._ready_at_s:
            self._ready_at_s = None
            self.on = not self.interlock_open and not self.fault
        self._tell(now_s)
        return b""

    def _reply(self, command: str, now_s: float) -> bytes:
        self.commands.append(command)
        if FORBIDDEN.fullmatch(command):
            self.forbidden.append(command)
        if now_s < self._quiet_since_s + self._gap_s:
            return b""  # still busy with the last one
        if command.startswith("!"):
            return b""  # command modulation never replies
        self._quiet_since_s = now_s
        text = self._answer(command.lower(), now_s)
        self._tell(now_s)
        return self.junk + text.encode("ascii") + b"\r\n"

    def _answer(self, command: str, now_s: float) -> str:
        said = self._query(command)
        if said is not None:
            return said
        name, _, value = command.partition(" ")
        done = self._common(name, now_s)
        if not done:
            done = self._set_mld(name, value) if self.family == "06-MLD" else self._set_scpi(_short(name), value)
        return "OK" if done else ILLEGAL

    def _query(self, command: str) -> str | None:
        said = self._query_common(command)
        if said is None:
            said = self._query_mld(command) if self.family == "06-MLD" else self._query_scpi(_short(command))
        return said

    def _query_common(self, command: str) -> str | None:
        match command:
            case "?":
                return "OK"
            case "sn?":
                return self.serial
            case "gfv?" | "ver?":
                return self.firmware
            case "glm?" if "." in self.firmware:  # -04- types have no dot there, and do not know it
                return self.model
            case "hrs?":
                return "123.45"
            case "l?":
                return "1" if self.on else "0"
            case "@cobas?":
                return "1" if self.autostart else "0"
            case "@cobasks?":
                return "1" if self.key_on else "0"
            case "ilk?":
                return "1" if self.interlock_open else "0"
            case "f?":
                return str(self.fault)
            case "gmlp?":
                return f"{self.max_power_w * 1e3:.1f}"
            case "p?":
                return f"{self.constant_power_w:.4f}"
            case "pa?":
                return f"{self.power_w:.4f}"
            case "i?":
                return f"{self.current_ma if self.on else 0.0:.1f}"
        return None

    def _query_mld(self, command: str) -> str | None:
        match command:
            case "gam?":
                return _MODE_NUMBER[self.mode]
            case "gdmes?":
                return "1" if self.digital else "0"
            case "games?":
                return "1" if self.analog else "0"
            case "glmp?":
                return f"{self.modulation_power_w * 1e3:.4f}"
            case "glp?":
                return f"{self.constant_power_w * 1e3:.4f}"
            case "glc?":
                return f"{self.current_ma:.1f}"
            case "gom?":
                return self._operating_mode()
        return None

    def _operating_mode(self) -> str:
        if self.fault:
            return "5"
        if self.waiting_for_key:
            return "1"
        if not self.on:
            return "0"
        return "4" if self.mode == "modulation" else "2"

    def _query_scpi(self, command: str) -> str | None:
        match command:
            case "state?":
                return self._state()
            case "las:runm?":
                return _RUN_MODE_NAME[self.mode]
            case "las:pm:dig:ena?":
                return "1" if self.digital else "0"
            case "las:pm:ana:ena?":
                return "1" if self.analog else "0"
            case "las:pm:pow:setp?":
                return f"{self.modulation_power_w * 1e3:.4f}"
            case "las:cp:pow:setp?":
                return f"{self.constant_power_w * 1e3:.4f}"
            case "las:pow?":
                return f"{self.power_w * 1e3:.4f}"
        return None

    def _state(self) -> str:
        if self.waiting_for_key:
            return "AutostartWaitingForKeyOn"
        return "AutostartLaserOn" if self.on else "AutostartStandby"

    def _common(self, name: str, now_s: float) -> bool:
        match name:
            case "l0":
                self._stop()
                self.key_needed = self.autostart
            case "l1" if not self.autostart:
                self.on = not self.interlock_open and not self.fault
            case "@cob1":
                if self.key_needed or not self.key_on:
                    self.waiting_for_key = True
                elif not self.on and self._ready_at_s is None:
                    self._ready_at_s = now_s + self.warm_up_s
            case "@cob0":
                self.waiting_for_key = False
                self._ready_at_s = None
            case "cf":
                self.fault = 3 if self.interlock_open else 0
            case _:
                return False
        return True

    def _set_mld(self, name: str, value: str) -> bool:
        match name:
            case "em":
                self.mode = "modulation"
            case "cp":
                self.mode = "constant power"
            case "ci":
                self.mode = "constant current"
            case "sdmes" if value in "01":
                self.digital = value == "1"
            case "sames" if value in "01":
                self.analog = value == "1"
            case "slmp" if (power_w := self._power(value, 1e-3)) is not None:
                self.modulation_power_w = power_w
            case "slp" if (power_w := self._power(value, 1e-3)) is not None:
                self.constant_power_w = power_w
            case "p" if (power_w := self._power(value, 1.0)) is not None:
                self.constant_power_w = power_w
            case "slc":
                self.current_ma = float(value)
            case _:
                return False
        return True

    def _set_scpi(self, name: str, value: str) -> bool:
        match name:
            case "las:runm" if value in _RUN_MODES:
                self.mode = _RUN_MODES[value]
            case "las:pm:dig:ena" if value in "01":
                self.digital = value == "1"
            case "las:pm:ana:ena" if value in "01":
                self.analog = value == "1"
            case "las:pm:dig:modulator" if value in ("external", "command"):
                self.modulator = value
            case "las:pm:pow:setp" if (power_w := self._power(value, 1e-3)) is not None:
                self.modulation_power_w = power_w
            case "las:cp:pow:setp" if (power_w := self._power(value, 1e-3)) is not None:
                self.constant_power_w = power_w
            case "p" if (power_w := self._power(value, 1.0)) is not None:
                self.constant_power_w = power_w
            case "las:paus" if value in "01":
                self.paused = value == "1"
            case _:
                return False
        return True

    def _power(self, value: str, unit_w: float) -> float | None:
        try:
            power_w = float(value) * unit_w
        except ValueError:
            return None
        return power_w if 0 <= power_w <= self.max_power_w * (1 + 1e-9) else None

    def _stop(self) -> None:
        self.on = False
        self.waiting_for_key = False
        self._ready_at_s = None

    def _tell(self, now_s: float) -> None:
        shown = (self.emitting, self.power_w)
        if shown != self._shown:
            self._shown = shown
            if self.on_emission is not None:
                self.on_emission(self.emitting, now_s)


def _short(command: str) -> str:
    """A command in its short form."""
    asks = command.endswith("?")
    words = command.removesuffix("?").split(":")
    return ":".join(_SHORT.get(word, word) for word in words) + "?" * asks
