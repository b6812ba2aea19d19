"""Model of a Coherent OBIS laser's firmware: handshake on or off, warm-up, CDRH delay, interlock, key, fault words.

Each fact has its public source in the table of docs/reference/devices/obis.md. Commands end with CR or LF, replies with
CRLF; words may be written short (`SYST`) or long (`SYSTem`). The model has the traps of the real laser: set commands
get no answer with the handshake off, ON during warm-up is deferred, emission follows ON by the CDRH delay, mode changes
are refused while the laser is on (ERR-200), no status word has the bit 'ready' (unless `words` is "ready"), without its
key it says that the interlock is open, behind a Remote only numbered commands reach it, and without a Remote none of
them does.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

Series = Literal["LX", "LS"]
"""LX has a laser diode, LS an optically pumped semiconductor."""
Words = Literal["plain", "marked", "ready"]
"""Form of a unit's status and fault words without a fault: see `ObisModel`."""

OFF_BITS = 0xC800_0000
"""Bits that are set in every sample status in docs/reference/devices/obis.md."""
POWERED = 0x1000
"""Status bit of the 12 V supply of the laser power (`LaserPowerVoltage` in `obis.h` of jamolnng/hapi)."""
READY = 0x4
"""Status bit 'ready' of the manual's table, which is in no word that a real laser is known to have said."""
_ALWAYS: dict[Words, tuple[int, int]] = {
    "plain": (OFF_BITS, 0),
    "ready": (OFF_BITS, 0),
    "marked": (OFF_BITS | 0x1080, 0x8000_0000),
}
"""Bits that are always set in the status word and in the fault word of a unit."""
TYPES: dict[Series, str] = {"LX": "DDL", "LS": "OPSL"}
"""Answers to `SYST:INF:TYP?`."""
_MODES: dict[Series, tuple[str, ...]] = {
    "LX": ("CWP", "CWC", "DIGITAL", "ANALOG", "MIXED", "DIGSO", "MIXSO"),
    "LS": ("CWP", "DIGITAL", "ANALOG", "MIXED"),
}
"""Operating modes, as `SOUR:AM:SOUR?` says them."""
_INTERNAL = ("CWP", "CWC")
_MODE_WORDS = {"DIG": "DIGITAL", "ANAL": "ANALOG", "MIX": "MIXED"}
"""Short forms of modes in commands."""
_COMMAND = re.compile(r"[^\r\n]+[\r\n]+")
_ADDRESS = re.compile(r"^(SYST|SOUR|\*IDN)(\d*)(?=[:?])")
_LONG_WORDS = (
    "SYSTem SOURce INFormation MODel SNUMber WAVelength TYPe POWer LEVel IMMediate AMPLitude LIMit NOMinal "
    "TEMPerature APRobe BASeplate INTernal EXTernal STATe STATus FAULt AUTostart COMMunicate HANDshaking PROMpt ERRor "
    "CLEar COUNt"
)
_SHORT = {word.upper(): "".join(letter for letter in word if letter.isupper()) for word in _LONG_WORDS.split()}
"""Short form of each word that has two forms; the laser understands both."""
_NO_REMOTE = ("", "0")
"""Numbers that mean the device at the other end of the cable: `SYST` is `SYST0`."""
FORBIDDEN = "SYST:CDRH OFF"
"""The command that bypasses a safeguard: a driver that sends it has failed its test."""
_SWITCHES = {"SYST:CDRH": "cdrh", "SYST:AUT": "autostart", "SOUR:TEMP:APR": "tec"}
"""Commands that switch one of the model's attributes."""
_SETTINGS = ("SOUR:POW:LEV:IMM:AMPL", "SOUR:AM:INT", "SOUR:AM:EXT", "SOUR:AM:STAT", *_SWITCHES)
"""All commands that set something about the laser."""


@dataclass(eq=False, kw_only=True)
class ObisModel:
    """The laser. Its attributes are the truth, for tests to look at; the driver sees only the replies.

    on_emission(emits, now_s) is called when `emitting` or `power_w` has changed. channel: the laser's slot, if it is on
    a Remote. words: "plain" units say C8000008 when idle and 00000000 without a fault; "marked" ones have the bits
    0x1080 set in the status and say 80000000 without a fault; "ready" ones set the bit 0x4 when they could be switched
    on, as the manual's table has it. emission_bit_lag_s: time for which the status still says 'emission' after the
    laser was switched off.
    """

    handshake: bool = True
    channel: int | None = None
    series: Series = "LX"
    words: Words = "plain"
    emission_bit_lag_s: float = 0.0
    prompt: bool = False
    """Only stored: what a prompt looks like is not public."""
    serial: str = "123456789012"
    least_power_w: float = 0.002
    max_power_w: float = 0.11
    warm_up_s: float = 0.0
    cdrh_delay_s: float = 5.0
    on_emission: Callable[[bool, float], None] | None = None
    key_on: bool = True
    interlock_open: bool = False
    fault: int = 0
    state_on: bool = False
    mode: str = "CWP"
    set_power_w: float = 0.002
    cdrh: bool = True
    autostart: bool = False
    tec: bool = True
    base_c: float = 24.6
    base_range_c: tuple[float, float] | None = (10.0, 50.0)
    """Range of the base plate's temperature that this unit states; None: it states none."""
    forbidden: list[str] = field(default_factory=list)
    commands: list[str] = field(default_factory=list)
    _warm_at_s: float | None = None
    _lit_at_s: float | None = None
    _said_until_s: float = float("-inf")
    """Time until which the status still says 'emission' of light that has gone off."""
    _now_s: float = 0.0
    _pending: str = ""
    _shown: tuple[bool, float] = (False, 0.0)

    @property
    def warm(self) -> bool:
        """Whether the warm-up is over."""
        return self._warm_at_s is not None and self._now_s >= self._warm_at_s

    @property
    def able(self) -> bool:
        """Whether nothing forbids emission."""
        return self.key_on and not self.interlock_open and not self.fault

    @property
    def emitting(self) -> bool:
        """Whether the laser would shine through an open gate."""
        return self.able and self.state_on and self._lit_at_s is not None and self._now_s >= self._lit_at_s

    @property
    def gated(self) -> bool:
        """Whether the TTL input controls the light."""
        return self.mode == "DIGITAL"

    @property
    def power_w(self) -> float:
        """Power in W that comes out now; for a gated laser, the power that an open gate lets out."""
        return self.set_power_w if self.emitting else 0.0

    def shine(self, power_w: float, *, gated: bool = True) -> None:
        """Switch the laser on, as an earlier user may have left it. `on_emission` is called at the next `tick`."""
        self.state_on = True
        self._warm_at_s = self._lit_at_s = float("-inf")
        self.mode = "DIGITAL" if gated else "CWP"
        self.set_power_w = power_w

    def open_interlock(self, now_s: float) -> None:
        """Open the interlock: until it is closed and ON is sent again, the laser is off."""
        self.tick(now_s)
        self.interlock_open = True
        self._switch(False)
        self._tell()

    def turn_key(self, on: bool, now_s: float) -> None:
        """Turn the key of the Remote: off darkens the laser; on switches it on, unless something forbids it."""
        self.tick(now_s)
        self.key_on = on
        self._switch(on and self.able)
        self._tell()

    def power_up(self, now_s: float) -> None:
        """Take the supply away and give it back: with autostart the laser switches itself on, unless something forbids
        it (`able`)."""
        self._now_s = now_s
        self._pending, self._warm_at_s, self._said_until_s = "", None, float("-inf")
        self.state_on, self._lit_at_s = False, None
        self._switch(self.autostart and self.able)
        self._tell()

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take bytes of commands; returns the replies."""
        self.tick(now_s)
        self._pending += data.decode("ascii", "replace")
        out = ""
        while (found := _COMMAND.match(self._pending.lstrip("\r\n"))) is not None:
            self._pending = self._pending.lstrip("\r\n")[found.end() :]
            out += self._reply(found[0].strip().upper())
        self._tell()
        return out.encode("ascii")

    def tick(self, now_s: float) -> bytes:
        """Let time pass, so that warm-up and delay can end. The laser never sends anything unasked."""
        self._now_s = now_s
        if self._warm_at_s is None:
            self._warm_at_s = now_s + self.warm_up_s
        if self.state_on and self._lit_at_s is None and self.warm and self.able:
            self._lit_at_s = now_s + (self.cdrh_delay_s if self.cdrh else 0.0)
        self._tell()
        return b""

    def _reply(self, command: str) -> str:
        self.commands.append(command)
        command = re.sub("[A-Z]+", lambda word: _SHORT.get(word[0], word[0]), command)
        address = _ADDRESS.match(command)
        bare = _ADDRESS.sub(r"\1", command)
        if bare == FORBIDDEN:
            self.forbidden.append(bare)
        number = address[2] if address else ""
        to_remote = self.channel is not None and number in _NO_REMOTE
        there = number in _NO_REMOTE or number == str(self.channel)
        if command.endswith("?"):
            said = self._query(bare, to_remote) if there else "ERR-241"
            if said.startswith("ERR"):
                return f"{said}\r\n"
            return f"{said}\r\n" + ("OK\r\n" if self.handshake else "")
        if not there:
            error = -241
        elif (session := self._set_session(bare)) is not None:
            error = session
        else:
            error = -100 if to_remote else self._set(bare)
        if not self.handshake:
            return ""
        return f"ERR{error}\r\n" if error else "OK\r\n"

    def _query(self, command: str, to_remote: bool) -> str:
        """The answer to a question, or an error."""
        if command == "SYST:COMM:HAND?":
            return _switch(self.handshake)
        if command == "SYST:COMM:PROM?":
            return _switch(self.prompt)
        if command == "*IDN?":
            name = "OBIS Remote" if to_remote else "OBIS 488nm 100mW C"
            return f"Coherent, Inc - {name} - V1.8.2 - Dec 14 2010"
        return (None if to_remote else self._query_laser(command)) or "ERR-100"

    def _query_laser(self, command: str) -> str | None:
        answers = {
            "SYST:INF:MOD?": "OBIS 488nm 100mW",
            "SYST:INF:SNUM?": self.serial,
            "SYST:INF:TYP?": TYPES[self.series],
            "SYST:INF:WAV?": "488.0",
            "SYST:INF:POW?": "0.10000",
            "SYST:STAT?": f"{self._bits():08X}",
            "SYST:FAUL?": f"{_ALWAYS[self.words][1] | self.fault:08X}",
            "SYST:LOCK?": _switch(not self.interlock_open and self.key_on),
            "SYST:CDRH?": _switch(self.cdrh),
            "SYST:AUT?": _switch(self.autostart),
            "SOUR:AM:STAT?": _switch(self.state_on),
            "SOUR:AM:SOUR?": self.mode,
            "SOUR:POW:LEV:IMM:AMPL?": f"{self.set_power_w:.5f}",
            "SOUR:POW:LEV?": f"{self.power_w:.5f}",
            "SOUR:POW:NOM?": "0.10000",
            "SOUR:POW:LIM:LOW?": f"{self.least_power_w:.5f}",
            "SOUR:POW:LIM:HIGH?": f"{self.max_power_w:.5f}",
            "SOUR:TEMP:APR?": _switch(self.tec),
            "SOUR:TEMP:BAS?": f"{self.base_c:.1f}C",
        }
        if self.base_range_c is not None:
            answers["SOUR:TEMP:PROT:BAS:LOW?"] = f"{self.base_range_c[0]:.1f}C"
            answers["SOUR:TEMP:PROT:BAS:HIGH?"] = f"{self.base_range_c[1]:.1f}C"
        return answers.get(command)

    def _bits(self) -> int:
        delayed = self.state_on and self._lit_at_s is not None and not self.emitting and self.able
        emission = self.emitting or self._now_s < self._said_until_s
        bits = {
            0x1: self.fault,
            0x2: emission,
            READY: self.words == "ready" and self.warm and self.able and not self.state_on,
            0x8: self.warm and not (emission or delayed or self.fault),
            0x10: delayed,
            0x100: not self.warm,
            0x400: self.mode not in _INTERNAL,
            POWERED: self.state_on and self.key_on and not self.interlock_open,
            0x0200_0000: not self.key_on,
            0x0400_0000: self.interlock_open or not self.key_on,
        }
        always, _ = _ALWAYS[self.words]
        return always | sum(bit for bit, is_set in bits.items() if is_set)

    def _set_session(self, command: str) -> int | None:
        """Obey a command about the dialogue itself; returns the error number, 0 for none, None for other commands."""
        name, _, value = command.partition(" ")
        if name == "SYST:ERR:CLE":
            return 0
        if name not in ("SYST:COMM:HAND", "SYST:COMM:PROM"):
            return None
        if value not in ("ON", "OFF"):
            return -220 if value else -109
        if name.endswith("HAND"):
            self.handshake = value == "ON"
        else:
            self.prompt = value == "ON"
        return 0

    def _set(self, command: str) -> int:
        """Obey a command that sets something; returns the error number, 0 for none."""
        name, _, value = command.partition(" ")
        if name not in _SETTINGS:
            return -100
        if not value:
            return -109
        if name == "SOUR:POW:LEV:IMM:AMPL":
            return self._change_power(value)
        if name in ("SOUR:AM:INT", "SOUR:AM:EXT"):
            mode = _MODE_WORDS.get(value, value)
            fits = mode in _MODES[self.series] and (mode in _INTERNAL) == name.endswith("INT")
            return self._change_mode(mode) if fits else -220
        if value not in ("ON", "OFF"):
            return -220
        if name in _SWITCHES:
            setattr(self, _SWITCHES[name], value == "ON")
            return 0
        if value == "ON" and not self.able:
            return -200
        self._switch(value == "ON")
        return 0

    def _switch(self, on: bool) -> None:
        if on != self.state_on:
            if not on and self._lit_at_s is not None and self._now_s >= self._lit_at_s:
                self._said_until_s = self._now_s + self.emission_bit_lag_s
            self._lit_at_s = None
        self.state_on = on
        self.tick(self._now_s)

    def _change_mode(self, mode: str) -> int:
        if self.state_on:
            return -200
        self.mode = mode
        return 0

    def _change_power(self, value: str) -> int:
        try:
            power_w = float(value)
        except ValueError:
            return -220
        if not self.least_power_w <= power_w <= self.max_power_w:
            return -220
        self.set_power_w = power_w
        return 0

    def _tell(self) -> None:
        shown = (self.emitting, self.power_w)
        if shown != self._shown:
            self._shown = shown
            if self.on_emission is not None:
                self.on_emission(self.emitting, self._now_s)


def _switch(on: bool) -> str:
    return "ON" if on else "OFF"
