"""Model of a Toptica iBeam smart laser's firmware: prompt, echo and talk, two channels, digital input, interlock.

Each fact has its public source in the table of docs/reference/devices/ibeam.md. Words may be shortened (`la on`),
commands end with CR, and an LF is ignored. An answer is CRLF, the lines, then `[OK]` and CRLF, or `CMD> ` without a
line end while the prompt is on, as after power-up. The model has the traps of the real laser: powers are in mW unless
`micro` follows, channel 1 is a bias that the digital input does not switch, `laser on` enables the default channel
again, `disable ext` lets channel 2 shine, channel 2 cannot be switched while `ext` is enabled, errors end with `[OK]`
too, `%SYS-I` lines are no errors, `talk quiet` swallows answers, and replies can fall one behind.

The manual is not public. Made up here: numbers and texts of errors and of the lines of `talk gabby`, the text after a
start, tables beyond the lines that clients look for, that an open interlock or a key turned off darkens the laser and
makes it refuse `laser on`, that a power beyond the largest is refused, that the channels' sum stops at the largest
power, and that echo, prompt and talk are forgotten without power. FINE is only stored. Not modelled: the service level
(`power mode cw`).
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

Talk = Literal["usual", "gabby", "quiet"]

OK, PROMPT = "[OK]\r\n", "CMD> "
"""End of an answer without and with the prompt."""
BIAS, NORMAL = 1, 2
"""Channels: the bias level, and the level that the digital input switches."""
BANNER = "\r\n\r\niBeam smart\r\n%SYS-I-001, system started\r\n"
UNKNOWN = "%SYS-E-001, unknown command"
PARAMETER = "%SYS-E-025, parameter error"
LOCKED = "%SYS-E-030, laser locked"
EXTERNAL = "%SYS-E-040, channel is controlled by EXT"
SCALED = "%SYS-I-077, scaled"
"""Line that some units say before what they measure."""
MOST_MA = 250.0
"""Current at the largest power; no real unit's."""
_WORDS = re.findall(
    r"\w+",
    "laser level limit channel clip current on off enable echo ext disable data power prompt status show system serial "
    "satellite temperature talk usual uptime gabby quiet micro fine reset id version",
)
"""Words of commands; a shorter form means the first word that begins with it."""
_QUIET = ("show serial", "serial", "id")
"""Questions that get no answer in `talk quiet`."""
_COMMAND = re.compile(r"[^\r]*\r")
_NUMBER = re.compile(r"\d+(\.\d*)?")


@dataclass(eq=False, kw_only=True)
class IbeamModel:
    """The laser. Its attributes are the truth, for tests to look at; the driver sees only the replies.

    on_emission(emits, now_s) is called whenever the light behind an open or closed gate changes. default_channel: the
    one that `laser on` enables; None: it enables none. disabled_shine: whether channels shine that are not enabled, as
    users say of some. pulse_board: whether `ext` means the digital input; without it `ext` means an analog input, where
    0 V is full power. scaled: whether `SCALED` comes before power, current and temperature. lag_gap_s: a command that
    comes sooner than this after the last one makes all replies late by one, until `reset system`. on_delay_s: time from
    `laser on` to the light, while the status says ON.
    """

    serial: str = "iBEAM-SMART-640-S-A3-12345"
    version: str = "iBPs-001A01-05"
    max_power_w: float = 0.15
    default_channel: int | None = BIAS
    disabled_shine: bool = False
    pulse_board: bool = True
    scaled: bool = True
    lag_gap_s: float = 0.0
    on_delay_s: float = 0.0
    on_emission: Callable[[bool, float], None] | None = None
    echo: bool = True
    prompt: bool = True
    talk: Talk = "usual"
    powers_w: dict[int, float] = field(default_factory=lambda: {BIAS: 0.001, NORMAL: 0.01})
    enabled: set[int] = field(default_factory=lambda: {BIAS})
    ext: bool = False
    fine: bool = False
    clip: str = "GOOD"
    state_on: bool = False
    key_on: bool = True
    interlock_open: bool = False
    fault: str = ""
    """Text of a `%SYS-F` line that keeps the laser off; empty: none."""
    gate_high: bool = False
    """Level of the digital input, for what the laser measures."""
    base_c: float = 30.2
    lagging: bool = False
    commands: list[str] = field(default_factory=list)
    _lit_at_s: float = 0.0
    _now_s: float = 0.0
    _last_s: float = float("-inf")
    """Time of the last command."""
    _pending: str = ""
    _late: str = ""
    """Reply that waits for the next command."""
    _unasked: str = ""
    _shown: tuple[bool, float, float] = (False, 0.0, 0.0)

    @property
    def able(self) -> bool:
        """Whether nothing forbids emission."""
        return self.key_on and not self.interlock_open and not self.fault

    @property
    def gated(self) -> bool:
        """Whether the digital input switches channel 2."""
        return self.ext and self.pulse_board

    @property
    def emitting(self) -> bool:
        """Whether the laser would shine through an open gate."""
        return self.power_w > 0

    @property
    def power_w(self) -> float:
        """Power in W that comes out now; for a gated laser, the power that an open gate lets out."""
        return self._level_w()

    @property
    def closed_gate_power_w(self) -> float:
        """Power in W that comes out while the digital input is low."""
        return self._level_w(NORMAL) if self.gated else self.power_w

    def shine(self, power_w: float, *, gated: bool = True) -> None:
        """Switch the laser on, as an earlier user may have left it. `on_emission` is called at the next `tick`."""
        self.state_on, self._lit_at_s = True, float("-inf")
        self.enabled, self.ext = {BIAS, NORMAL}, gated
        self.powers_w = {BIAS: 0.0, NORMAL: power_w}

    def open_interlock(self, now_s: float) -> None:
        """Open the interlock: until it is closed and `laser on` is sent again, the laser is off."""
        self._now_s, self.interlock_open, self.state_on = now_s, True, False
        self._tell()

    def turn_key(self, on: bool, now_s: float) -> None:
        """Turn the key: off darkens the laser, and on does not switch it on."""
        self._now_s, self.key_on, self.state_on = now_s, on, self.state_on and on
        self._tell()

    def set_fault(self, text: str, now_s: float) -> None:
        """Let a fatal fault switch the laser off. It cannot be switched on as long as `fault` holds a text."""
        self._now_s, self.fault, self.state_on = now_s, text, False
        self._tell()

    def power_up(self, now_s: float) -> None:
        """Switch the supply off and on. Laser and `ext` are off then, and echo and prompt are on."""
        self._now_s = now_s
        self._pending = self._late = ""
        self._last_s = float("-inf")
        self.state_on = self.ext = self.lagging = False
        self.echo, self.prompt, self.talk = True, True, "usual"
        self._unasked = BANNER + PROMPT
        self._tell()

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take bytes of commands; returns echo and replies."""
        out = self.tick(now_s).decode("ascii")
        self._pending += data.decode("ascii", "replace").replace("\n", "")
        while (found := _COMMAND.match(self._pending)) is not None:
            self._pending = self._pending[found.end() :]
            command = found[0].strip()
            echo = command if self.echo else ""
            out += echo + self._late_by_one(self._reply(command))
        self._tell()
        return (out + self._take_unasked()).encode("ascii", "replace")

    def tick(self, now_s: float) -> bytes:
        """Let time pass; returns the text after a start."""
        self._now_s = now_s
        self._tell()
        return self._take_unasked().encode("ascii")

    def _level_w(self, without: int = 0) -> float:
        """Sum of the levels of the channels that shine, without one of them. 0 while the driver is off."""
        if not (self.state_on and self.able and self._now_s >= self._lit_at_s):
            return 0.0
        shining = (self.enabled | set(self.powers_w if self.disabled_shine else ())) - {without}
        return min(sum(self.powers_w[one] for one in shining), self.max_power_w)

    def _take_unasked(self) -> str:
        out, self._unasked = self._unasked, ""
        return out

    def _late_by_one(self, reply: str) -> str:
        """Hold a reply back until the next command if the laser lags, and let it lag if commands come too fast."""
        self.lagging |= self._now_s - self._last_s < self.lag_gap_s
        self._last_s = self._now_s
        if self.lagging:
            reply, self._late = self._late, reply
        return reply

    def _reply(self, command: str) -> str:
        self.commands.append(command)
        words = " ".join(_long(word) for word in command.lower().split())
        if words == "reset system":
            self.power_up(self._now_s)
            return ""
        lines = self._query(words)
        if lines is None:
            lines = self._obey(words)
        if self.talk == "quiet" and words and (words in _QUIET or not lines):
            return ""
        return "\r\n" + "".join(f"{line}\r\n" for line in lines) + (PROMPT if self.prompt else OK)

    def _obey(self, words: str) -> list[str]:
        """Obey a command that is no question; returns the lines of its answer."""
        if error := self._set(words):
            return [error]
        return [f"%SYS-I-002, {words}"] if self.talk == "gabby" and words else []

    def _query(self, words: str) -> list[str] | None:
        """Lines of the answer to a question; None for other commands."""
        if (found := re.fullmatch(r"(status|show) channel (\d+)", words)) is not None:
            channel = int(found[2])
            if channel not in self.powers_w:
                return [PARAMETER]
            state = _switch(channel in self.enabled)
            return [state] if found[1] == "status" else [f"CH{channel}", f"status: {state.lower()}"]
        serial, note = [f"SN: {self.serial}"], [SCALED] if self.scaled else []
        measured_w = self.power_w if self.gate_high else self.closed_gate_power_w
        answers = {
            "status laser": [_switch(self.state_on)],
            "status ext": [_switch(self.ext)],
            "status fine": [_switch(self.fine)],
            "status clip": [self.clip],
            "status temperature": ["ON"],
            "status uptime": [f"PowerUP: {_hours(self._now_s)}", f"LaserON: {_hours(self._now_s / 2)}"],
            "show power": [*note, f"PIC  = {round(measured_w * 1e6):06d} uW  "],
            "show current": [*note, f"LDC  = {measured_w / self.max_power_w * MOST_MA:.1f} mA  "],
            "show temperature": [*note, "TEMP = 25.0  C"],
            "show temperature system": [f"TEMP = {self.base_c:.1f} C"],
            "show level power": [f"CH{one}, PWR: {power_w * 1e3:.3f} mW" for one, power_w in self.powers_w.items()],
            "show limit": [f"CH{one}: {MOST_MA:.1f} mA" for one in self.powers_w],
            "show serial": serial,
            "serial": serial,
            "id": serial,
            "version": [self.version],
            "show system": [f"   pulse board: {'yes' if self.pulse_board else 'no'}", "   SPP modes: Normal"],
            "show satellite": self._satellite(),
            "show data": [*self._satellite(), f"   enable EXT: {_switch(self.ext)}", "   fine a -> 0 %"],
        }
        return answers.get(words)

    def _satellite(self) -> list[str]:
        levels = [f"   CH{one} setp: {power_w * 1e3:.3f} mW" for one, power_w in self.powers_w.items()]
        return ["", f"   Pmax: {self.max_power_w * 1e3:.0f} mW", *levels]

    def _set(self, words: str) -> str:
        """Obey a command that sets something; returns the line of an error, or nothing."""
        if (found := re.fullmatch(r"channel (\d+) power (\S+)( micro)?", words)) is not None:
            return self._set_power(int(found[1]), found[2], 1e-6 if found[3] else 1e-3)
        match words.split():
            case []:
                pass
            case ["echo" | "prompt" | "fine" as name, "on" | "off" as value]:
                setattr(self, name, value == "on")
            case ["talk", "usual" | "gabby" | "quiet" as talk]:
                self.talk = talk
            case ["laser", "on" | "off" as value]:
                return self._switch_laser(value == "on")
            case ["enable" | "disable" as verb, "ext"]:
                self.ext = verb == "enable"
            case ["enable" | "disable" as verb, channel]:
                return self._switch_channel(channel, verb == "enable")
            case [("echo" | "prompt" | "fine" | "talk" | "laser" | "enable" | "disable" | "channel" | "reset"), *_]:
                return PARAMETER
            case _:
                return UNKNOWN
        return ""

    def _set_power(self, channel: int, value: str, unit_w: float) -> str:
        if channel not in self.powers_w or not _NUMBER.fullmatch(value):
            return PARAMETER
        power_w = float(value) * unit_w
        if power_w > self.max_power_w * (1 + 1e-9):
            return PARAMETER
        self.powers_w[channel] = power_w
        return ""

    def _switch_laser(self, on: bool) -> str:
        if on and not self.able:
            return f"%SYS-F-050, {self.fault}" if self.fault else LOCKED
        if on and not self.state_on:
            self._lit_at_s = self._now_s + self.on_delay_s
        if on and self.default_channel is not None:
            self.enabled.add(self.default_channel)
        self.state_on = on
        return ""

    def _switch_channel(self, channel: str, on: bool) -> str:
        """Enable or disable one channel, or with 0 all of them."""
        if not channel.isdecimal() or int(channel) not in (0, *self.powers_w):
            return PARAMETER
        channels = set(self.powers_w) if int(channel) == 0 else {int(channel)}
        if self.ext and NORMAL in channels:
            return EXTERNAL
        self.enabled = self.enabled | channels if on else self.enabled - channels
        return ""

    def _tell(self) -> None:
        shown = (self.emitting, self.power_w, self.closed_gate_power_w)
        if shown != self._shown:
            self._shown = shown
            if self.on_emission is not None:
                self.on_emission(self.emitting, self._now_s)


def _long(word: str) -> str:
    """The whole word for a short form; what is no word stays as it is."""
    if word == "x":
        return "ext"
    return next((one for one in _WORDS if len(word) > 1 and one.startswith(word)), word)


def _switch(on: bool) -> str:
    return "ON" if on else "OFF"


def _hours(time_s: float) -> str:
    hours, seconds = divmod(max(0, int(time_s)), 3600)
    return f"{hours} h + {seconds} s"
