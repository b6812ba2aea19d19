"""Properties of an emulated NI card and of its tasks, by the numbers that NI-DAQmx gives them."""

from collections.abc import Mapping
from typing import Any, Final

from sim_backend.wire.firmware.nidaq_parts.daq_card import TERMINALS, Card
from sim_backend.wire.firmware.nidaq_parts.daq_task import (
    AO_MAX,
    AO_MIN,
    AO_RATES_HZ,
    DELAY_TICKS,
    DO_RATE_HZ,
    FIFO,
    HIGH_TICKS,
    IDLE,
    LOW_TICKS,
    ON_DEMAND,
    ONBOARD_ONLY,
    PORT_LINES,
    RANGES_V,
    RATE,
    SOURCE,
    TICK_SOURCE,
    TIMEBASE_HZ,
    TIMING,
    Channel,
    DaqmxError,
    Task,
    expand,
)

BUFFER_SIZE, ONBOARD_SIZE = 0x186D, 0x230B
_PULSE_FREQUENCY, _PULSE_TICKS, _PULSE_TIME = 10119, 10268, 10269
_CO_USAGE: Final = 0x18B5
_TYPES: Final = {"ai": 10100, "ao": 10102, "do": 10153, "co": 10132}
_SETTABLE: Final = {
    "ai": (),
    "ao": (AO_MAX, AO_MIN, ONBOARD_ONLY),
    "do": (),
    "co": (IDLE, DELAY_TICKS, LOW_TICKS, HIGH_TICKS, TICK_SOURCE),
}
"""Properties of channels that can be set."""
_VERSION: Final = {0x1272: 26, 0x1923: 0, 0x2F22: 0}


def of_system(card: Card, number: int) -> Any:
    """A property of the driver: its version, or the names of its devices."""
    if number == 0x193B:
        return card.name
    if number in _VERSION:
        return _VERSION[number]
    raise DaqmxError(-200197, f"Property: {number:#x}")


def of_device(card: Card, number: int) -> Any:
    """A property of the card."""
    outputs = list(card.outputs)
    lines = [one for one in outputs if one.startswith("port")]
    ports = [f"port{n}" for n in range(len(PORT_LINES))]

    def names(wanted: list[str]) -> str:
        return ", ".join(f"{card.name}/{one}" for one in wanted)

    values: dict[int, Any] = {
        0x0631: "PCIe-6363",
        0x0632: card.serial,
        0x231D: 0x7435C4C4,  # of the simulated PCIe-6363 in nidaqmx-python's tests/max_config
        0x29A9: 15858,  # X Series DAQ
        0x2326: 13612,  # PCI Express
        0x22CA: False,  # simulated by the driver
        0x231F: names([one for one in outputs if one.startswith("ao")]),
        0x2325: names([one for one in outputs if one.startswith("ctr")]),
        0x2320: names(lines),
        0x2322: names(lines),
        0x2321: names(ports),
        0x2323: names(ports),
        0x2324: names([one for one in outputs if one.startswith("ctr")]),
        0x2A40: ", ".join(f"/{card.name}/{one}" for one in TERMINALS),
        0x2996: True,
        0x2997: AO_RATES_HZ[0],
        0x2998: TIMEBASE_HZ / 2**32,
        0x299A: DO_RATE_HZ,
        0x299B: [limit for one in RANGES_V for limit in (-one, one)],
        0x2FD3: [10322],  # voltage
        0x2FDD: [10178, 10123],
        0x2985: True,
        0x3165: 1,
        0x3168: 1,
    }
    if number not in values:
        raise DaqmxError(-200197, f"Device: {card.name}. Property: {number:#x}")
    return values[number]


def of_physical(card: Card, name: str, number: int) -> Any:
    """A property of a physical channel."""
    first, _, _ = card.physical(name, "")[0].partition("/")
    values: dict[int, Any] = {}
    if first.startswith("ao"):
        values = {0x2FD9: [10322]}
    elif first.startswith("port"):
        clocked = first == "port0"
        values = {0x29A7: PORT_LINES[int(first[4:])], 0x29A8: clocked, 0x2FE1: [10178, 10123] if clocked else []}
    elif first.startswith("ctr"):
        values = {0x2FDB: [_PULSE_TIME, _PULSE_FREQUENCY, _PULSE_TICKS]}
    if number not in values:
        raise DaqmxError(-200197, f"Physical Channel: {name}. Property: {number:#x}")
    return values[number]


def of_task(card: Card, task: Task, group: str, fields: Mapping[str, Any], now_s: float) -> Any:
    """A property of a task, of its timing, trigger, buffer or writing, or of its channels."""
    number = fields["attribute"]
    values: Mapping[int, Any] = {}
    if group == "Task":
        values = {
            0x1276: task.name,
            0x1273: ", ".join(channel.name for channel in task.channels),
            0x2181: len(task.channels),
            0x230E: card.name if task.channels else "",
            0x29BA: 1 if task.channels else 0,
        }
    elif group == "Timing":
        values = _of_timing(card, task, number)
    elif group == "Trig":
        values = task.trigger | {0x190F: False}
    elif group == "Chan":
        values = _of_channel(card, task, channels_named(task, fields["channel"])[0])
    elif group == "Write":
        if task.error is not None and task.state == 4:
            raise DaqmxError(task.error.code, f"Task Name: {task.name}")
        generated = task.generated(now_s)
        ahead = 0 if task.regenerates else max(0, task.written - generated - (task.fifo if task.buffered else 0))
        values = task.writing | {
            0x1458: task.written,
            0x192B: generated,
            0x1460: task.buffer_size - ahead,
            0x217E: len(task.channels),
            0x217F: max((len(channel.outputs) for channel in task.channels), default=0),
        }
    elif group == "Read":
        values = {0x1823: ", ".join(channel.name for channel in task.channels), 0x217B: len(task.channels)}
    elif group == "Buffer":
        values = {BUFFER_SIZE: task.buffer_size, ONBOARD_SIZE: FIFO.get(task.kind, 0)}
    if number not in values:
        raise DaqmxError(-200452, f"Property: {number:#x}. Task Name: {task.name}")
    return values[number]


def set_property(card: Card, task: Task, group: str, fields: Mapping[str, Any]) -> None:
    """Set a property, or give it its default if `fields` has no value."""
    number, fresh = fields["attribute"], Task("")
    value = fields.get("value")
    if group == "Buffer" and number == BUFFER_SIZE:
        card.configure(task)
        task.size, task.buffer = value, None
        return
    pairs: list[tuple[dict[int, Any], dict[int, Any]]] = []
    if group == "Chan":
        given = {ONBOARD_ONLY: False, IDLE: 10214, AO_MIN: -10.0, AO_MAX: 10.0, TICK_SOURCE: ""}
        if number in _SETTABLE[task.kind or "do"]:
            pairs = [(channel.attributes, given) for channel in channels_named(task, fields["channel"])]
    else:
        own = {"Timing": "timing", "Trig": "trigger", "Write": "writing"}.get(group, "")
        if own and number in getattr(fresh, own):
            pairs = [(getattr(task, own), getattr(fresh, own))]
    if not pairs:
        raise DaqmxError(-200452, f"Property: {number:#x}. Task Name: {task.name}")
    for values, defaults in pairs:
        card.configure(task, values, {number: defaults.get(number) if value is None else value})


def pulses(rpc: str, fields: Any) -> dict[int, Any]:
    """Properties of a counter's channel, in ticks. Frequencies and times are rounded to ticks of 100 MHz."""
    values: dict[int, Any] = {TICK_SOURCE: ""}
    if rpc.endswith("Ticks"):
        values |= {TICK_SOURCE: fields.source_terminal, _CO_USAGE: _PULSE_TICKS}
        delay, low, high = fields.initial_delay, fields.low_ticks, fields.high_ticks
    elif rpc.endswith("Freq"):
        if fields.freq <= 0:
            raise DaqmxError(-200077, f"Property: CO.Pulse.Freq. Requested Value: {fields.freq}")
        period = round(TIMEBASE_HZ / fields.freq)
        high = round(period * fields.duty_cycle)
        values[_CO_USAGE] = _PULSE_FREQUENCY
        delay, low = round(fields.initial_delay * TIMEBASE_HZ), period - high
    else:
        values[_CO_USAGE] = _PULSE_TIME
        times = fields.initial_delay, fields.low_time, fields.high_time
        delay, low, high = (round(one * TIMEBASE_HZ) for one in times)
    return values | {DELAY_TICKS: delay, LOW_TICKS: low, HIGH_TICKS: high}


def channels_named(task: Task, text: str) -> list[Channel]:
    """The channels of a task with these names; "" means all of them."""
    wanted = _names(text)
    found = [channel for channel in task.channels if not wanted or channel.name in wanted]
    if not found:
        raise DaqmxError(-200452, f"Channel: {text}. Task Name: {task.name}")
    return found


def _names(text: str) -> set[str]:
    """Names in a list of channels, as given and with ranges written out."""
    return {*expand(text), *filter(None, (one.strip() for one in text.split(",")))}


def _of_timing(card: Card, task: Task, number: int) -> Mapping[int, Any]:
    if task.timing[TIMING] == ON_DEMAND:
        return {TIMING: ON_DEMAND}
    card.verify(task)
    if task.kind == "co":
        return {one: value for one, value in task.timing.items() if one not in (RATE, SOURCE)}
    source = card.source(task) or f"{task.kind}/SampleClockTimebase"
    return task.timing | {
        RATE: card.rate_hz(task),
        SOURCE: f"/{card.name}/{source}",
        0x22C8: card.highest_rate_hz(task),
        0x1303: float(TIMEBASE_HZ),
        0x1308: f"/{card.name}/100MHzTimebase",
        0x18EB: round(TIMEBASE_HZ / task.timing[RATE]),
        0x2F1B: f"/{card.name}/{task.kind}/SampleClock",
    }


def _of_channel(card: Card, task: Task, channel: Channel) -> Mapping[int, Any]:
    values = dict(channel.attributes) | {
        0x187F: _TYPES[task.kind],
        0x18F5: ", ".join(f"{card.name}/{one}" for one in channel.outputs),
    }
    if task.kind == "ao":
        full_v = channel.dac_range_v
        values |= {ONBOARD_ONLY: bool(values.get(ONBOARD_ONLY)), 0x1108: 10322, 0x182C: 16.0}
        values |= {0x182E: full_v, 0x182D: -full_v}
    elif task.kind == "ai":
        values[0x0695] = 10322  # voltage
    elif task.kind == "do":
        values[0x2179] = len(channel.outputs)
    else:
        delay, high, low = (values[one] for one in (DELAY_TICKS, HIGH_TICKS, LOW_TICKS))
        values |= {0x1178: TIMEBASE_HZ / (high + low), 0x1176: high / (high + low), 0x299: delay / TIMEBASE_HZ}
        values |= {0x18BA: high / TIMEBASE_HZ, 0x18BB: low / TIMEBASE_HZ, 0x18BC: delay / TIMEBASE_HZ}
        values[0x18E1] = f"/{card.name}/PFI{(12, 13, 14, 15)[int(channel.outputs[0][3:])]}"
    return values
