"""The Cobolt (Huebner) 06-01 line laser, gated by its digital modulation input.

Commands and replies are in docs/reference/devices/cobolt.md. Sources: cobolt-lasers/pycobolt 1333e53 (2025-09),
python-microscope `lights/cobolt.py`, and the vendor's adapter for Micro-Manager (mmCoreAndDevices 8431eb1,
DeviceAdapters/CoboltOfficial). Old firmware may send junk before a reply. The laser monitors its temperatures itself
and reports a wrong one as fault 1.

There are two command languages: that of the first 06-MLD lasers, and a SCPI-like one. The driver asks which of them the
laser speaks: the model number does not say it, since an 06-MLD comes with either firmware. An 06-DPL is refused, since
its power follows a gate only up to about 1 kHz. Not every unit knows every question: if it refuses one, the state of
its key or autostart counts as unknown.

After `pause` the laser must come on again without its key. After `l0` (off) it does not (pycobolt issue 6). So `pause`
blanks the light as the makers do: with `las:paus 1`, or with `l0r`, the shutter of the vendor's adapter; an 06-MLD that
knows no `l0r` goes to constant current at 0 mA, as in that adapter. No blanking can be read back, so the powers are set
to 0 too: the next program can read these. Whether a power of 0 alone is dark is in no source. If mode and power do not
read back as dark, `pause` switches the laser off. `disarm` sets the powers to 0 and sends `l0`; with autostart enabled
the key must then be turned off and on before the laser starts again. With autostart disabled the key is not needed, so
`close` sends `l0` too.
"""

import logging
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

from pydantic import Field

from drivers.errors import CommandRefused, DeviceError, DeviceFault, ProtocolError
from drivers.interfaces import LaserLimits, LaserStatus
from drivers.lasers.serial_laser import SerialLaser, SerialLaserConfig, open_laser, require_serial_number
from drivers.registry import Kind, Surroundings, alone, config_of
from drivers.transports.dialogue import DONE, FLAG, NUMBER, Dialogue, LineTiming
from drivers.units import Seconds

_log = logging.getLogger(__name__)

COUNT = re.compile(r"\d{1,4}")
WORD = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
NAME = re.compile(r"(?=.*\d)[A-Za-z0-9][A-Za-z0-9._/ -]*")
"""Form of model and serial numbers. They contain a digit, unlike all other replies in words."""
USUAL_TIMING = LineTiming(gap_s=0.1)

_REFUSED = re.compile(r"syntax error.*|.*\b(invalid|illegal)\b.*", re.IGNORECASE)
_JUNK = re.compile(r"^[^A-Za-z0-9+-]+")
_MOST_LINES = 3
"""Most lines to read for one reply: lines that are only junk or echo may come before it."""
_POWER_STEP_MW = 0.1
"""Every model resolves its power setting at least this finely."""


class CoboltFraming:
    """The form of a Cobolt's commands and replies."""

    ping = quickest = "?"

    def greets(self, reply: str) -> bool:
        """Whether the reply is `OK`."""
        return reply == DONE

    def asks(self, command: str) -> bool:
        """Whether the command is a question."""
        return "?" in command

    def encode(self, command: str) -> bytes:
        """The command's bytes, terminated by CR."""
        return command.encode("ascii") + b"\r"

    def read(self, command: str, read_line: Callable[[], str]) -> str:
        """The reply to the command, without junk or an echo of the command before it; "" if there is none."""
        for _ in range(_MOST_LINES):
            reply = _JUNK.sub("", read_line().rpartition(command)[2].strip())
            if reply:
                return reply
        return ""

    def refusal(self, reply: str) -> str | None:
        """The laser's own words if it refuses the command; None if it does not."""
        return reply if _REFUSED.fullmatch(reply) else None


@dataclass(frozen=True, slots=True)
class Dialect:
    """The words of one of the laser's command languages. The commands in `digital`, `analog` and `set_power` are sent
    with a space and a value after them; the queries are complete."""

    mode: str
    """Query of the mode; the answer has the form `mode_form`."""
    mode_form: re.Pattern[str]
    modulate: str
    """Command that selects the mode in which an input controls the light."""
    modulated: str
    """Name of that mode in answers, in lower case."""
    digital: tuple[str, str]
    analog: tuple[str, str]
    """Command and query for whether the TTL input (or the analog input) controls the light in that mode."""
    set_power: str
    """Command that sets the power while the gate is high, in milliwatts."""
    powers: Mapping[str, tuple[str, float]]
    """By mode: the query of the set power, and the reply's unit in watts. Modes without a set power are missing."""
    no_power: str
    """Command that sets the power of the constant-power mode to 0."""
    waits_for_key: tuple[str, re.Pattern[str], re.Pattern[str]]
    """Query of the laser's state, the form of its answers, and the form of those that mean: it waits for its key."""
    names: Mapping[str, str]
    """Names of the other modes, by the number that the laser reports."""
    autostart: tuple[str, ...]
    """Questions for whether autostart is enabled. The first one that the laser knows counts."""
    most_power: tuple[str, ...]
    """Questions for the most power, in milliwatts. The first one that the laser knows counts."""
    external: str = ""
    """Command that lets the input control the light, and not the host. Empty: not needed."""
    pauses: tuple[tuple[str, str], ...] = ()
    """Commands that blank the light at once, each with the one that ends that. The first that the laser knows is used.
    """
    pauses_any_time: bool = False
    """Whether every unit knows the first of `pauses` and obeys it also while it is off."""
    no_current: tuple[str, str, str, str] | None = None
    """Command that sets the current of the constant-current mode to 0, its query, the command that enters that mode,
    and the mode in answers. None: not known."""


MLD = Dialect(
    mode="gam?",
    mode_form=re.compile("[012]"),
    modulate="em",
    modulated="2",
    digital=("sdmes", "gdmes?"),
    analog=("sames", "games?"),
    set_power="slmp",
    powers={"1": ("p?", 1.0), "2": ("glmp?", 1e-3)},
    no_power="p 0",
    waits_for_key=("gom?", COUNT, re.compile("1")),
    names={"0": "constant current", "1": "constant power"},
    autostart=("@cobas?", "gas?"),
    most_power=("gmlp?",),
    pauses=(("l0r", "l1r"),),
    no_current=("slc 0", "glc?", "ecc", "0"),
)
"""The language of 06-MLD."""
SCPI = Dialect(
    mode="laser:runmode?",
    mode_form=WORD,
    modulate="laser:runmode PowerModulation",
    modulated="powermodulation",
    digital=("las:pm:dig:ena", "las:pm:dig:ena?"),
    analog=("las:pm:ana:ena", "las:pm:ana:ena?"),
    set_power="laser:powermodulation:power:setpoint",
    powers={
        "powermodulation": ("laser:powermodulation:power:setpoint?", 1e-3),
        "constantpower": ("laser:cp:power:setpoint?", 1e-3),
    },
    no_power="laser:cp:power:setpoint 0",
    waits_for_key=("state?", WORD, re.compile(".*waitingforkey.*", re.IGNORECASE)),
    names={},
    autostart=("@cobas?", "autostart:enabled?"),
    most_power=("laser:cp:power:setpoint? max", "gmlp?"),
    external="laser:pm:dig:modulator external",
    pauses=(("las:paus 1", "las:paus 0"), ("l0r", "l1r")),
    pauses_any_time=True,
)
"""The newer 06-01 language. With its modulator on "command" the laser obeys `!e` and `!d`, without an answer."""
DIALECTS = (SCPI, MLD)
"""Both languages, in the order in which they are tried: newer firmware may know words of the old one too."""


FAMILIES = {
    "06-DPL": r"-06-(5|9).*-\d{3,4}(-C)?$",  # in either language its power follows a gate up to 1 kHz only
    "06-01": r"-06-.*-1\d{3}(-C)?$",
    "06-MLD": r"-06-0",
}
"""Patterns of each family's model numbers, after pycobolt. The first match counts. Unlike there, an 06-DPL comes first,
whatever its language."""


def classify(model: str) -> str:
    """The laser family of a model number; "unknown" if no family has such numbers."""
    return next((family for family, numbers in FAMILIES.items() if re.search(numbers, model)), "unknown")


FAULTS = {1: "temperature", 3: "interlock was open", 4: "constant power timed out"}
"""Meanings of the answer to `f?`. 0: no fault."""


class CoboltConfig(SerialLaserConfig):
    """Config of a Cobolt 06-01 laser."""

    kind: Literal["cobolt"] = "cobolt"
    silence: Annotated[Seconds, Field(ge=0.05, le=2)] = 0.2
    """Longest time without an answer, as in `SerialLaserConfig`. No source says how soon a Cobolt answers a question;
    this is twice the time that it needs between two."""


class CoboltLaser(SerialLaser):
    """A Cobolt 06-01. `status` takes almost a second, since the laser allows at most ten commands a second."""

    def __init__(
        self, line: Dialogue, dialect: Dialect, name: str, limits: LaserLimits, autostart: bool | None
    ) -> None:
        """autostart: whether the laser's autostart is enabled; None: the laser does not say."""
        super().__init__(name, line, limits)
        self._dialect = dialect
        self._autostart = autostart
        self._tells_key = autostart is not False
        self._pauses = dialect.pauses
        """The pairs of `Dialect.pauses` that the laser knows or may know."""
        self._knows_pause = dialect.pauses_any_time
        self._blanked = False
        """Whether the light was blanked and that was not ended yet."""
        self._started = False

    @classmethod
    def open(
        cls, port: str, *, max_power_w: float, surroundings: Surroundings | None = None, **settings: Any
    ) -> "CoboltLaser":
        """Open a laser by itself, without a config file.

        port, settings (serial_number, baud): as in `CoboltConfig`. max_power_w: most power in watts that the laser may
        ever emit. surroundings: clock, tap and emulated ports; None: the system's clock and real ports only. Raises
        `LimitExceeded` for a setting that is not possible, and another `DeviceError` if the laser cannot be opened.
        """
        return create(config_of(CoboltConfig, port=port, max_power_w=max_power_w, **settings), surroundings or alone())

    def _do_status(self) -> LaserStatus:
        line = self._line
        # A flipped bit may fake an alarm, so what ends a scan is read twice. If it hides one, the next poll finds it.
        interlock_open = line.ask_flag("ilk?") and line.ask_flag("ilk?")
        fault = self._fault()
        on = line.ask_flag("l?")
        mode = self._mode()
        input_mode = self._input_mode(mode)
        set_w = self._power_w(mode) if on else 0.0
        key_on = self._key_on()
        if not on and fault is None and self._waits_for_key():
            fault = "it waits for its key: turn the key off and on"
        return LaserStatus(
            emission=on and (set_w is None or set_w > 0),
            armed=self._armed,
            interlock_closed=not interlock_open,
            fault=fault,
            key_on=key_on,
            warming_up=self._started and not on and fault is None and not interlock_open,
            input_mode=input_mode,
            power_w=line.ask_number("pa?") if on else 0.0,
        )

    def _key_on(self) -> bool | None:
        """Whether the key is on. None: it does not matter, or the laser does not know the question."""
        if not self._tells_key:
            return None
        try:
            return self._line.ask_flag("@cobasks?")
        except CommandRefused:
            self._tells_key = False  # a refusal takes most of a second, and the guard asks every second
            return None

    def _fault(self) -> str | None:
        number = int(self._line.ask("f?", COUNT)) and int(self._line.ask("f?", COUNT))
        return None if number == 0 else FAULTS.get(number, f"number {number}")

    def _mode(self) -> str:
        return self._line.ask(self._dialect.mode, self._dialect.mode_form).lower()

    def _input_mode(self, mode: str) -> str:
        """Name of the input or mode that controls the light. The gate alone controls it only if that is "digital"."""
        dialect = self._dialect
        if mode != dialect.modulated:
            return dialect.names.get(mode, mode)
        digital, analog = self._line.ask_flag(dialect.digital[1]), self._line.ask_flag(dialect.analog[1])
        if digital and not analog:
            return "digital"
        return "mixed" if digital else "analog" if analog else "modulation without input"

    def _power_w(self, mode: str) -> float | None:
        """The power in watts set in this mode; 0 at a constant current of 0. None: the mode has no set power."""
        no_current = self._dialect.no_current
        if no_current is not None and mode == no_current[3]:
            with suppress(CommandRefused):
                return 0.0 if self._line.ask_number(no_current[1]) == 0 else None
        if mode not in self._dialect.powers:
            return None
        question, unit_w = self._dialect.powers[mode]
        return self._line.ask_number(question) * unit_w

    def _waits_for_key(self) -> bool:
        question, form, waits = self._dialect.waits_for_key
        return waits.fullmatch(self._line.ask(question, form)) is not None

    def _do_arm(self, power_w: float) -> None:
        try:
            self._enable(power_w)
            self._require_no_stop()
            self._armed = True
        except BaseException:  # an interrupt too
            with suppress(DeviceError):  # the first error is the one to report
                self._darken(on=True)
            raise

    def _enable(self, power_w: float) -> None:
        """Keep the laser dark until the gate is known to control the light; only then set the power."""
        gated = all(self._input_mode(self._mode()) == "digital" for _ in range(2))  # a flipped bit must not shine
        on = self._line.ask_flag("l?")
        if not (gated and on and self._armed):
            gated &= self._darken(on=on)  # then it is dark whenever it comes on, until the power is set
        if not gated:
            self._gate()
        # Each exchange takes a tenth of a second: check for a pause from another thread before each step to light.
        self._require_no_stop()
        if not on:
            self._start()
        self._require_no_stop()
        self._set_power(power_w)
        self._require_no_stop()
        if self._blanked or self._dialect.pauses_any_time:
            self._end_blanking(on=on)

    def _gate(self) -> None:
        """Let only the TTL input control the light, and read that back. Call it while the laser is dark."""
        line, dialect = self._line, self._dialect
        for (command, question), value in ((dialect.digital, "1"), (dialect.analog, "0")):
            line.tell_and_check(f"{command} {value}", question, FLAG, value.__eq__)
        if dialect.external:
            line.tell(dialect.external)
        line.tell_and_check(
            dialect.modulate, dialect.mode, dialect.mode_form, lambda reply: reply.lower() == dialect.modulated
        )

    def _set_power(self, power_w: float) -> None:
        """Set the power that is emitted while the gate is high, and read it back."""
        command, (question, _) = self._dialect.set_power, self._dialect.powers[self._dialect.modulated]
        power_mw = power_w * 1e3
        slack_mw = max(0.01 * power_mw, _POWER_STEP_MW / 2)
        self._line.tell_and_check(
            f"{command} {power_mw:.4f}", question, NUMBER, lambda reply: abs(float(reply) - power_mw) <= slack_mw
        )

    def _darken(self, *, on: bool) -> bool:
        """Blank the light, and set the power to 0 in every mode that has one, at once and without the key. Returns
        whether the mode is still the one that it was.

        on: whether the laser may be on; one that is off is blanked only if its dialect has `pauses_any_time`.
        What is sure to be obeyed comes first: this may be an emergency. The next program can read the powers back.
        """
        to_blank = on or self._dialect.pauses_any_time
        blanked = to_blank and self._knows_pause and self._blank()
        try:
            self._set_power(0.0)
        except BaseException:  # an interrupt too
            if to_blank and not (blanked or self._blank()):
                self._cut_current()  # then the light ends at least
            raise
        if to_blank and not blanked:
            blanked = self._blank()
        self._line.tell(self._dialect.no_power)
        if to_blank and not blanked:
            self._cut_current()
            return False
        return True

    def _blank(self) -> bool:
        """Blank the light in a way that needs no key afterwards. False: the laser knows no command for that."""
        for pair in self._pauses:
            with suppress(CommandRefused):
                self._line.tell(pair[0])
                self._pauses = (pair,)
                self._knows_pause = self._blanked = True
                return True
        if not self._knows_pause:
            self._pauses = ()  # a refusal takes most of a second, which the next pause must not lose
        return False

    def _end_blanking(self, *, on: bool) -> None:
        """Let the light out again. on: whether the laser was on before it was armed; else a refusal is only logged."""
        try:
            self._line.tell(self._pauses[0][1])
        except CommandRefused:
            if on:
                raise
            _log.warning("%s: does not end its pause before it is on; if it stays dark, arm again", self._name)
        else:
            self._blanked = False

    def _cut_current(self) -> None:
        """Go to constant current at 0 mA. The current is not put back later: this mode does not follow the gate, and a
        pause from another thread could come between."""
        if self._dialect.no_current is None:
            raise DeviceFault(f"{self._name} knows no command that blanks its light")
        no_current, question, enter, mode = self._dialect.no_current
        self._line.tell_and_check(no_current, question, NUMBER, lambda reply: float(reply) == 0)
        self._line.tell_and_check(enter, self._dialect.mode, self._dialect.mode_form, mode.__eq__)

    def _start(self) -> None:
        """Switch on; emission follows once temperatures are reached. Raises `DeviceFault` if the laser waits for its
        key."""
        if self._autostart is None:
            try:
                self._line.tell("@cob1")
            except CommandRefused:
                self._line.tell("l1")  # refused itself while autostart is enabled, so no key is bypassed
        else:
            self._line.tell("@cob1" if self._autostart else "l1")
        self._started = True
        if not self._line.ask_flag("l?") and self._waits_for_key():
            # The start is not cancelled: once the key is turned, the laser comes on, and is dark.
            self._started = False
            raise DeviceFault(f"{self._name} waits for its key; turn the key off and on, then start again")

    def _do_pause(self) -> None:
        try:
            on = self._armed or self._started or any(self._line.ask_flag("l?") for _ in range(2))  # a bit may flip
            self._darken(on=on)
            power_w = self._power_w(self._mode())
        except (DeviceFault, ProtocolError) as error:
            _log.warning("%s: pause failed (%s); switching off", self._name, error)
            power_w = None
        if power_w != 0 and self._line.ask_flag("l?"):
            # The mode has no set power, or the laser did not accept it: only off is surely dark.
            self._switch_off()
            _log.warning("%s: switched off, its key must be turned before it starts again", self._name)

    def _make_safe(self) -> None:
        super()._make_safe()
        if self._autostart is False:  # then it starts again without its key, and need not stay on and dark
            self._switch_off()

    def _do_disarm(self) -> None:
        try:
            self._darken(on=False)  # `l0` follows at once, and the next start must not find it blanked
        finally:
            self._switch_off()
        self._armed = False

    def _switch_off(self) -> None:
        self._started = False
        self._line.tell("@cob0")  # also ends a start that is under way
        self._line.tell_and_check("l0", "l?", COUNT, "0".__eq__)


def create(config: CoboltConfig, surroundings: Surroundings, timing: LineTiming = USUAL_TIMING) -> CoboltLaser:
    """Open the laser and identify it; changes nothing about it. Raises `DeviceError` if that fails, or for a laser that
    this driver cannot run."""
    return open_laser("cobolt", config, surroundings, CoboltFraming(), timing, partial(_identify, config), _off(config))


def _identify(config: CoboltConfig, line: Dialogue) -> CoboltLaser:
    """Find out which laser answers, with as few questions as possible: each takes 0.1 s, and a guard waits for them.
    A refused one takes several times that.
    """
    try:
        model = line.ask_surely("glm?", NAME)
    except CommandRefused:
        raise DeviceFault(
            f"cobolt laser on {config.port} does not know its model, as -04- types do not; use an 06-01 laser"
        ) from None
    family = classify(model)
    if family == "06-DPL":
        raise DeviceFault(
            f"cobolt laser {model} is an 06-DPL: its power follows a gate up to 1 kHz only; use an 06-MLD"
        )
    if family == "unknown":
        raise DeviceFault(f"cobolt laser {model} is no 06-01 type; this driver runs 06-MLD and newer 06-01 lasers")
    dialect = _language(config, line, model)
    serial = line.ask_surely("sn?", NAME)
    require_serial_number("cobolt", config, serial)
    most_mw = _first_known(line, dialect.most_power, NUMBER)
    if most_mw is None:
        raise ProtocolError(f"{line.name} does not say its most power; check its firmware")
    limit_w = float(most_mw) * 1e-3
    if limit_w <= 0:
        raise ProtocolError(f"{line.name} says that its most power is {limit_w:g} W; check its cable and firmware")
    autostart = _first_known(line, dialect.autostart, FLAG)
    limits = LaserLimits(0.0, min(config.max_power, limit_w))
    name = f"Cobolt {model} {serial}"
    return CoboltLaser(line, dialect, name, limits, None if autostart is None else autostart == "1")


def _language(config: CoboltConfig, line: Dialogue, model: str) -> Dialect:
    """The language in which the laser answers the question for its mode."""
    for dialect in DIALECTS:
        # A refusal has not the form of an answer, even with a flipped bit.
        with suppress(CommandRefused):
            line.ask(dialect.mode, dialect.mode_form)
            return dialect
    raise DeviceFault(f"cobolt laser {model} on {config.port} knows neither of the 06-01 languages; use an 06-01 laser")


def _first_known(line: Dialogue, questions: tuple[str, ...], form: re.Pattern[str]) -> str | None:
    """The reply to the first of these questions that the laser knows; None if it refuses all of them."""
    for question in questions:
        with suppress(CommandRefused):
            return line.ask_surely(question, form)
    return None


def _off(config: CoboltConfig) -> bytes:
    """The bytes that switch off. No CR goes before them: it might count as a command, and the laser ignores others for
    0.1 s after one."""
    return b"l0\r"


KIND = Kind(config=CoboltConfig, create=create, off=_off)
