"""Model of a Cobolt 06-01 laser's firmware: 06-MLD or the newer SCPI-like language, key, autostart, interlock, faults.

Source: docs/reference/hardware.md (cobolt-lasers/pycobolt 1333e53). Commands end with CR, replies with CRLF. The model
has the traps of the real laser: no answer to a command sooner than 100 ms after the last reply, key needed after `l0`,
`l1` refused while autostart is enabled, powers in W (`p`) and mW (`slmp`), `ilk?` 1 = open, junk before replies, silent
`!e` and `!d`. `l0r` and `l1r` blank the light and end that, as a shutter would (mmCoreAndDevices 8431eb1).
"""

import re
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
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
_MODES: dict[Mode, tuple[str, str]] = {
    "constant current": ("0", "ConstantCurrent"),
    "constant power": ("1", "ConstantPower"),
    "modulation": ("2", "PowerModulation"),
}
"""Name of each mode in the replies of 06-MLD and of 06-01."""
_RUN_MODES = {name.lower(): mode for mode, (_, name) in _MODES.items()}
_MODE_COMMANDS: dict[str, Mode] = {"ecc": "constant current", "em": "modulation"}
"""Commands of 06-MLD that enter a mode."""
_FLAGS: dict[Family, dict[str, str]] = {
    "06-MLD": {"sdmes": "digital", "sames": "analog"},
    "06-01": {"las:pm:dig:ena": "digital", "las:pm:ana:ena": "analog", "las:paus": "paused"},
}
_POWERS: dict[Family, dict[str, tuple[str, float]]] = {
    "06-MLD": {"slmp": ("modulation_power_w", 1e-3), "p": ("constant_power_w", 1.0)},
    "06-01": {
        "las:pm:pow:setp": ("modulation_power_w", 1e-3),
        "las:cp:pow:setp": ("constant_power_w", 1e-3),
        "p": ("constant_power_w", 1.0),
    },
}
"""Commands that set a flag or a power, with the model's attribute for it, and a power's unit in watts."""


@dataclass(eq=False)
class CoboltModel:
    """The laser. Its attributes are the truth, for tests to look at; the driver sees only the replies.

    on_emission(emits, now_s) is called whenever power or emission change.
    """

    family: Family = "06-MLD"
    _: KW_ONLY
    model: str = ""
    """Its model number; empty: the usual one of the family."""
    serial: str = "16328"
    firmware: str = "4.1.3"
    refuses: frozenset[str] = frozenset()
    """Commands and questions that this unit does not know although others of its family do."""
    autostart: bool = True
    warm_up_s: float = 3.0
    junk: bytes = b""
    gap_s: float = GAP_S
    on_emission: Callable[[bool, float], None] | None = None
    max_power_w: float = 0.1
    key_on: bool = True
    key_needed: bool = False
    waiting_for_key: bool = False
    interlock_open: bool = False
    fault: int = 0
    on: bool = False
    paused: bool = False
    mode: Mode = "constant power"
    constant_power_w: float = 0.0
    modulation_power_w: float = 0.0
    current_ma: float = 0.0
    digital: bool = False
    analog: bool = False
    modulator: str = "external"
    forbidden: list[str] = field(default_factory=list)
    """Commands received that no driver may send."""
    commands: list[str] = field(default_factory=list)
    """All commands received."""
    _ready_at_s: float | None = None
    _quiet_since_s: float = float("-inf")
    _pending: bytes = b""
    _shown: tuple[bool, float] = (False, 0.0)

    @property
    def gated(self) -> bool:
        """Whether the TTL input controls the light."""
        return self.mode == "modulation" and self.digital and self.modulator == "external"

    @property
    def power_w(self) -> float:
        """Power in W that comes out now; for a gated laser, the power that an open gate lets out."""
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
        """Switch the laser on, as an earlier user may have left it."""
        self.on = True
        self.mode = "modulation" if gated else "constant power"
        self.digital = gated
        self.modulation_power_w = self.constant_power_w = power_w

    def turn_key(self, on: bool, now_s: float) -> None:
        """Turn the key on or off by hand."""
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
        """Open the interlock: the laser goes off, and `fault` stays 3 until a test sets it to 0."""
        self.interlock_open = True
        self.fault = 3
        self._stop()
        self._tell(now_s)

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take bytes of commands; returns the replies."""
        self.tick(now_s)
        self._pending += data
        out = b""
        while (end := self._pending.find(b"\r")) >= 0:
            command = self._pending[:end].decode("ascii", "replace").strip()
            self._pending = self._pending[end + 1 :]
            out += self._reply(command, now_s)
        return out

    def tick(self, now_s: float) -> bytes:
        """Let time pass, so that warm-up can end. The laser never sends anything unasked."""
        if self._ready_at_s is not None and now_s >= self._ready_at_s:
            self._ready_at_s = None
            self.on = not self.interlock_open and not self.fault
        self._tell(now_s)
        return b""

    def _reply(self, command: str, now_s: float) -> bytes:
        self.commands.append(command)
        if FORBIDDEN.fullmatch(command):
            self.forbidden.append(command)
        if now_s < self._quiet_since_s + self.gap_s:
            return b""  # still busy with the last one
        if command.startswith("!"):
            return b""  # command modulation never replies
        self._quiet_since_s = now_s
        text = self._answer(command.lower(), now_s)
        self._tell(now_s)
        return self.junk + text.encode("ascii") + b"\r\n"

    def _answer(self, command: str, now_s: float) -> str:
        name, _, value = command.partition(" ")
        if name in self.refuses or command in self.refuses:
            return ILLEGAL
        if self.family == "06-01":
            name = re.sub("[a-z]+", lambda word: _SHORT.get(word[0], word[0]), name)
        said = self._query(f"{name} {value}" if name.endswith("?") and value else name)
        if said is not None:
            return said
        return "OK" if self._act(name, now_s) or self._set(name, value) else ILLEGAL

    def _query(self, command: str) -> str | None:
        """The answer to a question; None if the laser does not know it."""
        answers = {
            "?": "OK",
            "sn?": self.serial,
            "l?": _flag(self.on),
            "@cobas?": _flag(self.autostart),
            "@cobasks?": _flag(self.key_on),
            "ilk?": _flag(self.interlock_open),
            "f?": str(self.fault),
            "gmlp?": f"{self.max_power_w * 1e3:.1f}",
            "p?": f"{self.constant_power_w:.4f}",
            "pa?": f"{self.power_w:.4f}",
        }
        if "." in self.firmware:  # -04- types have no dot there, and do not know it
            answers["glm?"] = self.model or MODELS[self.family]
        number, name = _MODES[self.mode]
        modulation = f"{self.modulation_power_w * 1e3:.4f}"
        if self.family == "06-MLD":
            answers |= {"gam?": number, "gdmes?": _flag(self.digital), "games?": _flag(self.analog)}
            answers |= {"glmp?": modulation, "gom?": self._operating_mode(), "gas?": _flag(self.autostart)}
            answers["glc?"] = f"{self.current_ma:.1f}"
        else:
            answers |= {"las:runm?": name, "las:pm:dig:ena?": _flag(self.digital), "state?": self._state()}
            answers |= {"las:pm:ana:ena?": _flag(self.analog), "las:pm:pow:setp?": modulation}
            answers["las:cp:pow:setp?"] = f"{self.constant_power_w * 1e3:.4f}"
            answers["las:cp:pow:setp? max"] = f"{self.max_power_w * 1e3:.1f}"
            answers["autostart:enabled?"] = _flag(self.autostart)
        return answers.get(command)

    def _operating_mode(self) -> str:
        if self.fault:
            return "5"
        if self.waiting_for_key:
            return "1"
        if not self.on:
            return "0"
        return "4" if self.mode == "modulation" else "2"

    def _state(self) -> str:
        if self.waiting_for_key:
            return "AutostartWaitingForKeyOn"
        return "AutostartLaserOn" if self.on else "AutostartStandby"

    def _act(self, name: str, now_s: float) -> bool:
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
            case "l0r" | "l1r":  # as a shutter; the key is not needed afterwards
                self.paused = name == "l0r"
            case "@cob0":
                self.waiting_for_key = False
                self._ready_at_s = None
            case _:
                return False
        return True

    def _set(self, name: str, value: str) -> bool:
        flag, (power, unit_w) = _FLAGS[self.family].get(name), _POWERS[self.family].get(name, ("", 1.0))
        if flag and value in ("0", "1"):
            setattr(self, flag, value == "1")
        elif power and (power_w := self._power(value, unit_w)) is not None:
            setattr(self, power, power_w)
        elif self.family == "06-MLD":
            if name == "slc" and value.replace(".", "", 1).isdigit():
                self.current_ma = float(value)
            elif name in _MODE_COMMANDS:
                self.mode = _MODE_COMMANDS[name]
            else:
                return False
        elif name == "las:runm" and value in _RUN_MODES:
            self.mode = _RUN_MODES[value]
        elif name == "las:pm:dig:modulator" and value in ("external", "command"):
            self.modulator = value
        else:
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


def _flag(value: bool) -> str:
    return "1" if value else "0"
