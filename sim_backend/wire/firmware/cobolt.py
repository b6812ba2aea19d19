"""Model of a Cobolt 06-01 laser's firmware: 06-MLD, 06-DPL or the newer SCPI-like language, key, autostart, faults.

Each fact has its public source in the table of docs/reference/devices/cobolt.md. Commands end with CR, replies with
CRLF. The model has the traps of the real laser: no answer to a command sooner than 100 ms after the last reply, key
needed after `l0`, `@cob0` and `@cob1` darken it, `l1` refused while autostart is enabled, `@cobasks?` unknown to
06-MLD, `gkses?` that says whether the key is in force but not how it is turned, powers in W (`p`) and mW (`slmp`,
`slp`), numbers of `gom?` that mean other things in 06-DPL, `ilk?` 1 = open, junk before replies, silent `!e` and `!d`.
"""

import re
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from typing import Literal

Family = Literal["06-MLD", "06-DPL", "06-01"]
Mode = Literal["constant current", "constant power", "modulation"]

MODELS: dict[Family, str] = {"06-MLD": "0488-06-01-0100-100", "06-01": "0488-06-01-0100-1100"}
"""A model number of the families with a diode, as `glm?` gives it."""
DPL_MODEL = "0561-06-91-0100-100"
"""A model number of the family 06-DPL: its fourth part is 51, 53, 57, 91, 93 or 97."""
ILLEGAL = "Syntax error: illegal command"
NOT_IN_AUTOSTART = "Syntax error: not allowed in autostart mode."
OUT_OF_RANGE = "Syntax error: Value is out of range."
FORBIDDEN = re.compile(r"@cobas \S+|@cobasky.*|@cobasdr.*")
"""Commands that bypass key and autostart: a driver that sends one of them has failed its test."""
_NUMBER = re.compile(r"[-+]?\d*\.?\d+")
MOST_MA = 100.0
"""Current at the largest power; no real unit's."""
_REFUSED: dict[Family, frozenset[str]] = {
    "06-MLD": frozenset({"@cobasks?"}),
    "06-DPL": frozenset({"@cobasks?"}),
    "06-01": frozenset(),
}
"""Questions that a family refuses although others of the make answer them."""
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
    "enabled": "ena",
    "reading": "read",
    "autostart": "auto",
    "keyswitch": "key",
}
_MODES: dict[Mode, tuple[str, str]] = {
    "constant current": ("0", "ConstantCurrent"),
    "constant power": ("1", "ConstantPower"),
    "modulation": ("2", "PowerModulation"),
}
"""Name of each mode in the replies of 06-MLD and of 06-01."""
_MODE_COMMANDS: dict[str, Mode] = {
    "ci": "constant current",
    "ecc": "constant current",
    "cp": "constant power",
    "ecp": "constant power",
    "em": "modulation",
}
"""Commands of 06-MLD and 06-DPL that enter a mode."""
_RUN_MODES = {name.lower(): mode for mode, (_, name) in _MODES.items()}
_FLAGS: dict[Family, dict[str, str]] = {
    "06-MLD": {"sdmes": "digital", "sames": "analog"},
    "06-DPL": {"sdmes": "digital", "sames": "analog"},
    "06-01": {"las:pm:dig:ena": "digital", "las:pm:ana:ena": "analog", "las:paus": "paused"},
}
_POWERS: dict[Family, dict[str, tuple[str, float]]] = {
    "06-MLD": {
        "slmp": ("modulation_power_w", 1e-3),
        "slp": ("constant_power_w", 1e-3),
        "p": ("constant_power_w", 1.0),
    },
    "06-DPL": {"slp": ("constant_power_w", 1e-3), "p": ("constant_power_w", 1.0)},
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

    on_emission(emits, now_s) is called when `emitting` or `power_w` has changed. refuses: commands and questions that
    this unit does not know; None: those of its family. shutter: whether it knows `l0r` and `l1r`, which pause and
    resume; None: as its family. key_cycle: whether `@cob1` waits in any state until the key is turned off and on again.
    deaf_s: time from the start of the warm-up for which it answers OK to a command for a power, but does not obey.
    """

    family: Family = "06-MLD"
    _: KW_ONLY
    model: str = ""
    """Its model number; empty: the usual one of the family."""
    serial: str = "16328"
    firmware: str = "4.1.3"
    autostart: bool = True
    warm_up_s: float = 3.0
    junk: bytes = b""
    gap_s: float = GAP_S
    refuses: frozenset[str] | None = None
    shutter: bool | None = None
    key_cycle: bool = False
    deaf_s: float = 0.0
    keyswitch: bool = True
    """Whether the key is in force, as `gkses?` says; how it is turned is `key_on`."""
    on_emission: Callable[[bool, float], None] | None = None
    max_power_w: float = 0.1
    key_on: bool = True
    key_needed: bool = False
    waiting_for_key: bool = False
    aborted: bool = False
    on_off: bool = False
    """On/off modulation of 06-MLD, which `eoom` enters."""
    interlock_open: bool = False
    fault: int = 0
    on: bool = False
    paused: bool = False
    mode: Mode = "constant power"
    constant_power_w: float = 0.0
    modulation_power_w: float = 0.0
    current_ma: float = 0.0
    high_ma: float = 0.0
    low_ma: float = 0.0
    """Currents of 06-DPL behind an open and a closed gate."""
    digital: bool = False
    analog: bool = False
    modulator: str = "external"
    forbidden: list[str] = field(default_factory=list)
    """Commands received that no driver may send."""
    commands: list[str] = field(default_factory=list)
    """All commands received."""
    _ready_at_s: float | None = None
    _hears_at_s: float = float("-inf")
    _now_s: float = 0.0
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
            case "modulation" if self.family == "06-DPL":
                return self.max_power_w * self.high_ma / MOST_MA
            case "modulation":
                return self.modulation_power_w
            case "constant power":
                return self.constant_power_w
            case _:
                return self.max_power_w * min(1.0, self.current_ma / MOST_MA)

    @property
    def emitting(self) -> bool:
        """Whether the laser would shine through an open gate."""
        return self.power_w > 0

    def shine(self, power_w: float, *, gated: bool = True) -> None:
        """Switch the laser on, as an earlier user may have left it. `on_emission` is called at the next `tick`."""
        self.on = True
        self.mode = "modulation" if gated else "constant power"
        self.digital = gated
        self.modulation_power_w = self.constant_power_w = power_w

    def turn_key(self, on: bool, now_s: float) -> None:
        """Turn the key on or off by hand. Off stops the laser; on starts the warm-up if the laser waits for the key."""
        self.key_on = on
        if not on:
            self._stop()
            self.waiting_for_key = self.autostart
        else:
            self.key_needed = False
            if self.waiting_for_key:
                self._start(now_s)
        self._tell(now_s)

    def open_interlock(self, now_s: float) -> None:
        """Open the interlock: the laser goes off, and `fault` stays 3 until `cf` with the interlock closed, or until a
        test sets it to 0."""
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
        self._now_s = now_s
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
        refused = _REFUSED[self.family] if self.refuses is None else self.refuses
        if name in refused or command in refused:
            return ILLEGAL
        if self.family == "06-01":
            name = re.sub("[a-z]+", lambda word: _SHORT.get(word[0], word[0]), name)
            if name.endswith("?") and value == "max":
                name, value = f"{name} max", ""
        said = self._query(name)
        if said is not None:
            return said
        if name == "l1" and self.autostart:
            return NOT_IN_AUTOSTART
        if self._act(name, value, now_s) or self._set(name, value):
            return "OK"
        return OUT_OF_RANGE if name in _POWERS[self.family] and _NUMBER.fullmatch(value) else ILLEGAL

    def _query(self, command: str) -> str | None:
        """The answer to a question; None if the laser does not know it."""
        answers = {
            "?": "OK",
            "sn?": self.serial,
            "gsn?": self.serial,
            "gfv?": f"CAP-1004-{self.firmware}" if self.family == "06-01" else self.firmware,
            "hrs?": "828.98",
            "l?": _flag(self.on),
            "@cobas?": _flag(self.autostart),
            "@cobasks?": _flag(self.key_on),
            "@cobasks": _flag(self.key_on),
            "gkses?": _flag(self.keyswitch),
            "ilk?": _flag(self.interlock_open),
            "f?": str(self.fault),
            "gmlp?": f"{self.max_power_w * 1e3:.1f}",
            "gmlc?": f"{MOST_MA:.1f}",
            "glc?": f"{self.current_ma:.1f}",
            "i?": f"{self._diode_ma:.1f}",
            "p?": f"{self.constant_power_w:.4f}",
            "pa?": f"{self.power_w:.4f}",
        }
        if "." in self.firmware:  # -04- types have no dot there, and do not know it
            answers["glm?"] = self.model or MODELS.get(self.family, DPL_MODEL)
        answers |= self._scpi_answers() if self.family == "06-01" else self._legacy_answers()
        return answers.get(command)

    def _legacy_answers(self) -> dict[str, str]:
        answers = {
            "gam?": _MODES[self.mode][0],
            "gas?": _flag(self.autostart),
            "gdmes?": _flag(self.digital),
            "games?": _flag(self.analog),
            "glp?": f"{self.constant_power_w * 1e3:.1f}",
            "gom?": self._operating_mode(),
        }
        if self.family == "06-DPL":
            return answers | {"gmc?": f"{self.high_ma:.1f}", "glth?": f"{self.low_ma:.1f}"}
        return answers | {"glmp?": f"{self.modulation_power_w * 1e3:.1f}"}

    def _scpi_answers(self) -> dict[str, str]:
        most = f"{self.max_power_w * 1e3:.4f}"
        return {
            "las:runm?": _MODES[self.mode][1],
            "las:pm:dig:ena?": _flag(self.digital),
            "las:pm:ana:ena?": _flag(self.analog),
            "las:pm:pow:setp?": f"{self.modulation_power_w * 1e3:.4f}",
            "las:cp:pow:setp?": f"{self.constant_power_w * 1e3:.4f}",
            "las:pm:pow:setp? max": most,
            "las:cp:pow:setp? max": most,
            "las:pow?": f"{self.power_w * 1e3:.4f}",
            "las:pow:read?": f"{self.power_w * 1e3:.4f}",
            "auto:ena?": _flag(self.autostart),
            "key:ena?": _flag(self.keyswitch),
            "key?": _flag(self.key_on),
            "state?": self._state(),
        }

    @property
    def _diode_ma(self) -> float:
        """Current through the diode in mA; no real curve."""
        return MOST_MA * self.power_w / self.max_power_w

    def _operating_mode(self) -> str:
        """The answer to `gom?`. 06-DPL has a number for the warm-up, and others for what comes after it."""
        diode = self.family == "06-MLD"
        if self.fault:
            return "5"
        if self.aborted:
            return "6"
        if self.waiting_for_key:
            return "1"
        if not self.on:
            return "3" if self._ready_at_s is not None and not diode else "0"
        if self.mode == "modulation":
            return "4" if diode else "7"
        return ("3" if self.on_off else "2") if diode else "4"

    def _state(self) -> str:
        if self.waiting_for_key:
            return "AutostartWaitingForKeyOn"
        return "AutostartLaserOn" if self.on else "AutostartStandby"

    def _act(self, name: str, value: str, now_s: float) -> bool:
        shutter = self.family == "06-01" if self.shutter is None else self.shutter
        match name:
            case "l0":
                self._stop()
                self.key_needed = self.autostart
            case "@cob0" | "abort" | "auto:abort":
                self._stop()
                self.aborted = self.key_needed = self.autostart
            case "l1":
                self.aborted = False
                self.on = not self.interlock_open and not self.fault
            case "@cob1":
                waits = self.waiting_for_key or (self.autostart and self.on) or self.key_cycle or self.key_needed
                self._stop()
                if waits or not self.key_on:
                    self.waiting_for_key = True
                else:
                    self._start(now_s)
            case "restart" | "auto:restart":
                self._stop()
                self.waiting_for_key = True
            case "@cobas" if value in ("0", "1"):
                if value == "1" and not self.autostart:
                    self._stop()
                self.autostart = value == "1"
            case "cf" | "fault:clear":
                self.fault = 3 if self.interlock_open else 0
            case "l0r" | "l1r" if shutter:
                self.paused = name == "l0r"
            case _:
                return False
        return True

    def _set(self, name: str, value: str) -> bool:
        flag, (power, unit_w) = _FLAGS[self.family].get(name), _POWERS[self.family].get(name, ("", 1.0))
        if flag and value in ("0", "1"):
            setattr(self, flag, value == "1")
        elif power:
            power_w = self._power(value, unit_w)
            if power_w is None:
                return False
            if self._now_s >= self._hears_at_s:
                setattr(self, power, power_w)
        elif name == "slc" or (self.family == "06-DPL" and name in ("smc", "slth")):
            return self._set_current({"slc": "current_ma", "smc": "high_ma", "slth": "low_ma"}[name], value)
        elif self.family != "06-01":
            if name in ("eoom", "xoom") and self.family == "06-MLD":
                self.on_off = name == "eoom"
                return True
            if name not in _MODE_COMMANDS:
                return False
            self.mode = _MODE_COMMANDS[name]
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

    def _set_current(self, attribute: str, value: str) -> bool:
        try:
            current_ma = float(value)
        except ValueError:
            return False
        if not 0 <= current_ma <= MOST_MA:
            return False
        setattr(self, attribute, current_ma)
        return True

    def _start(self, now_s: float) -> None:
        """Begin the warm-up, after which it is on."""
        self.waiting_for_key = False
        self._ready_at_s = now_s + self.warm_up_s
        self._hears_at_s = now_s + self.deaf_s

    def _stop(self) -> None:
        self.on = False
        self.waiting_for_key = False
        self.aborted = False
        self._ready_at_s = None

    def _tell(self, now_s: float) -> None:
        shown = (self.emitting, self.power_w)
        if shown != self._shown:
            self._shown = shown
            if self.on_emission is not None:
                self.on_emission(self.emitting, now_s)


def _flag(value: bool) -> str:
    return "1" if value else "0"
