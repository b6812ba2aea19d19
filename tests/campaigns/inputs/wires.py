"""What devices answer: each driver is opened on a wire that plays the answers of an input, and asked for its state.

An input is a list of answers, each with its length in two bytes before it. The driver gets one for each command that it
sends, and silence once they are used up. The seeds are the answers of the emulated devices. Time is virtual.
"""

import errno
import json
import re
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import serial
import usb.core
import usb.util

from drivers.clock import NS_PER_S, VirtualClock
from drivers.errors import DeviceDisconnected, DeviceError, DeviceTimeout, LimitExceeded
from drivers.interfaces import OUT_GATE, Pulse
from drivers.lasers import cobolt, ibeam, obis
from drivers.registry import Surroundings
from drivers.scanners.etherdream_line import Broadcast, EtherDreamLine
from drivers.scanners.helios import HeliosConfig, HeliosDac
from drivers.scanners.lasercube import LaserCubeConfig, LaserCubeDac
from drivers.spads import spad512s_line
from drivers.spads.spb_usb_setup import block_size, identify
from drivers.spb1.control import COMMAND, IDENTITY_MAGIC, Ack, ControlChannel, Op
from drivers.sync import pulsestreamer
from drivers.sync.prawndo import PrawnDo, PrawnDoConfig
from drivers.sync.teensy import Teensy, TeensyConfig
from drivers.transports.endpoints import Endpoint
from drivers.transports.usb_device import UsbId, attached
from sim_backend.wire.firmware.cobolt import CoboltModel
from sim_backend.wire.firmware.ibeam import IbeamModel
from sim_backend.wire.firmware.obis import ObisModel
from sim_backend.wire.firmware.prawndo import PrawnDoModel
from sim_backend.wire.firmware.pulsestreamer import PulseStreamerModel
from sim_backend.wire.firmware.teensy import TeensyModel
from tests.campaigns.inputs.changes import Changes, Tree
from tests.campaigns.inputs.fuzz import Target

_LENGTH = struct.Struct("<H")
_SLICE_S = 0.02
_MOST_COMMANDS = 400
"""A driver that has sent so many commands is cut off: the wire is lost."""


def pack(answers: Sequence[bytes]) -> bytes:
    """An input of these answers."""
    return b"".join(_LENGTH.pack(len(each)) + each for each in answers)


def unpack(data: bytes) -> Iterator[bytes]:
    """The answers of an input, as far as they are there."""
    at = 0
    while at + _LENGTH.size <= len(data):
        (length,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size
        yield data[at : at + length]
        at += length


class Answers:
    """The answers of an input in turn, on a virtual clock; then silence."""

    def __init__(self, data: bytes) -> None:
        self.clock = VirtualClock()
        self._left = unpack(data)
        self._sent = 0

    def next(self) -> bytes:
        """The answer to one more command."""
        self._sent += 1
        if self._sent > _MOST_COMMANDS:
            raise serial.SerialException(errno.EIO, "the input is used up")
        return next(self._left, b"")


class Port:
    """The part of `serial.Serial` that the drivers use."""

    def __init__(self, answers: Answers) -> None:
        self.clock = answers.clock
        self._answers = answers
        self._came = bytearray()
        self.in_waiting = 0

    def write(self, data: bytes) -> None:
        """Send, and get the next answer at once."""
        self._came += self._answers.next()
        self.in_waiting = len(self._came)

    def read(self, size: int) -> bytes:
        """What has come; nothing after a slice of time."""
        data = bytes(self._came[:size])
        del self._came[:size]
        self.in_waiting = len(self._came)
        if size and not data:
            self.clock.sleep(_SLICE_S)
        return data

    def fileno(self) -> int:
        """No file, so that nobody looks for a hang-up."""
        raise ValueError

    def close(self) -> None:
        """Nothing is open."""


class TaggedPort(Port):
    """The port of a Teensy: an answer gets the tag of its command and the checksum, without which it counts as none."""

    def write(self, data: bytes) -> None:
        """Send, and get the next answer if the command has a tag."""
        tag = re.match(rb"\n?(#[0-9a-f]{8} )", data)
        if tag is not None and (said := self._answers.next()):
            said = tag[1] + said
            self._came += said + b" *%08x\n" % zlib.crc32(said)
            self.in_waiting = len(self._came)


def _surroundings(slot: str, answers: Answers, kind: type[Port] = Port) -> Surroundings:
    port = kind(answers)
    return Surroundings(answers.clock, None, 0, {slot: Endpoint("/dev/input", serial_port=lambda: port)})


def _laser(make: Any, config: Any, data: bytes) -> None:
    made = make.create(config.model_validate({"port": "emulated:laser", "max_power": "80 mW"}),
                       _surroundings("laser", Answers(data)))  # fmt: skip
    try:
        made.status  # noqa: B018
        made.arm(0.01)
        made.pause()
    finally:
        made.close()


_SWEEP = (Pulse(0, None), Pulse(OUT_GATE, 5e-3), Pulse(0, 1e-5))


def _sync(make: Any, config: Any, kind: type[Port], data: bytes) -> None:
    made = make(config.model_validate({"port": "emulated:sync"}), _surroundings("sync", Answers(data), kind))
    try:
        made.status  # noqa: B018
        made.program(_SWEEP, 2)
        made.gate_low()
    finally:
        made.close()


class Link:
    """The part of `UsbDevice` that the drivers of DACs and of SPB1 boards use."""

    label, listing = "device at usb", SimpleNamespace(serial="1")

    def __init__(self, answers: Answers) -> None:
        self.clock = answers.clock
        self._answers = answers
        self._came: list[bytes] = []

    def write(self, endpoint: int, data: bytes, timeout_s: float) -> None:
        """Send, and get the next answer at once."""
        try:
            answer = self._answers.next()
            self._came += [answer] if answer else []
        except serial.SerialException:
            raise DeviceDisconnected("device at usb: the device is gone") from None

    def read(self, endpoint: int, size: int, timeout_s: float) -> bytes:
        """The oldest answer."""
        data = self._came.pop(0) if self._came else b""
        if not data:
            self.clock.sleep(timeout_s)
            raise DeviceTimeout("device at usb: nothing within the time")
        return data[:size]

    def drain(self, endpoint: int, size: int, timeout_s: float) -> int:
        """Drop what has come."""
        self._came.clear()
        return 0

    def set_alternate(self, interface: int, alternate: int) -> None:
        """Nothing changes."""

    def close(self) -> None:
        """Nothing is open."""


_GALVO = {"max_velocity": "2000 /s", "max_acceleration": "2e6 /s2"}


def _helios(data: bytes) -> None:
    link = Link(Answers(data))
    dac = HeliosDac(HeliosConfig.model_validate(_GALVO | {"kind": "helios"}), link, link.clock)  # type: ignore[arg-type]
    dac.check()
    dac.close()


def _lasercube(data: bytes) -> None:
    link = Link(Answers(data))
    dac = LaserCubeDac(LaserCubeConfig.model_validate(_GALVO | {"kind": "lasercube"}), link, link.clock)  # type: ignore[arg-type]
    dac.check()
    dac.set_rate(30_000)
    dac.close()


class Registers(Link):
    """An SPB1 board whose registers have the values of an input, in the order in which they are asked for first."""

    def __init__(self, answers: Answers) -> None:
        super().__init__(answers)
        self._values: dict[int, int] = {}

    def write(self, endpoint: int, data: bytes, timeout_s: float) -> None:
        """Acknowledge each command."""
        acks = b""
        for _, op, request_id, address, _ in COMMAND.iter_unpack(data):
            if op == Op.READ and address not in self._values:
                self._values[address] = int.from_bytes(self._answers.next()[:4], "little")
            acks += Ack(op, request_id, 0, self._values.get(address, 0)).packed()
        self._came += [acks] if acks and op != Op.ABORT else []


def _spb_usb(data: bytes) -> None:
    link = Registers(Answers(data))
    found = identify(ControlChannel(link, 0x01, 0x82, 0x81, link.clock, None), "SPB1 SPAD")  # type: ignore[arg-type]
    with suppress(LimitExceeded):
        block_size(found, found.info.width, 10, "SPB1 SPAD")


def _board() -> list[bytes]:
    texts = [b"model".ljust(64, b"\0"), b"serial".ljust(64, b"\0")]
    words = [text[at : at + 4] for text in texts for at in range(0, 64, 4)]
    numbers = (IDENTITY_MAGIC, 0x100, 0x1F, 512 | 512 << 16, 100_000_000, 1, 400_000_000, 64, 1000, 4096, 1 << 20)
    memory = (1 << 30, 0)
    return [pack([value.to_bytes(4, "little") for value in (*numbers, *memory)] + words)]


class Stream:
    """The part of `TcpStream` that the drivers use."""

    peer = "192.0.2.1"

    def __init__(self, answers: Answers, first: bool = True) -> None:
        self._answers = answers
        self._came = bytearray(answers.next() if first else b"")

    def send(self, data: bytes, deadline_s: float) -> None:
        """Send, and get the next answer at once."""
        try:
            self._came += self._answers.next()
        except serial.SerialException:
            raise DeviceDisconnected("device: the connection is lost") from None

    def receive(self, deadline_s: float) -> bytes:
        """What has come."""
        data = bytes(self._came)
        self._came.clear()
        return data

    def receive_exactly(self, n: int, deadline_s: float) -> bytes:
        """The next n bytes that have come."""
        data = bytes(self._came[:n])
        del self._came[:n]
        return data

    def receive_into(self, view: memoryview, deadline_s: float) -> int:
        """What fits of what has come."""
        data = self.receive_exactly(len(view), deadline_s)
        view[: len(data)] = data
        return len(data)

    def drain(self, quiet_s: float, deadline_s: float) -> bytes:
        """All that has come."""
        return self.receive(deadline_s)

    def close(self) -> None:
        """Nothing is open."""


def _etherdream(data: bytes) -> None:
    answers = Answers(data)
    Broadcast.read(data[:36])
    line = EtherDreamLine("Ether Dream", Endpoint("192.0.2.1", tcp_stream=lambda: Stream(answers)))
    line.version()
    line.tell(b"p")
    line.ask(b"?")


def _spad512s(data: bytes) -> None:
    answers = Answers(data)
    line = spad512s_line.Spad512sLine("SPAD512S", "192.0.2.1:9999", spad512s_line.Deadlines())
    line._stream = stream = Stream(answers)  # type: ignore[assignment]
    assert str(line._greet(stream)).isprintable()  # type: ignore[arg-type]
    numbers = line.ask_numbers("R", 6)
    assert np.isfinite(numbers).all(), "numbers that are none"
    line.leave_run()


def _use_box(exchange: Callable[[bytes], bytes], clock: VirtualClock) -> None:
    """Open a box whose calls are answered by a function, and ask it for its state."""

    class Rpc(pulsestreamer.JsonRpc):
        def _exchange(self, method: str, body: bytes, within_s: float, retry_s: float) -> bytes:
            return exchange(body)

    usual, pulsestreamer.JsonRpc = pulsestreamer.JsonRpc, Rpc  # type: ignore[misc]
    try:
        config = pulsestreamer.PulseStreamerConfig.model_validate({"port": "192.0.2.1"})
        box = pulsestreamer.PulseStreamer(config, Surroundings(clock, None, 0, {}))
        box._forgotten.detach()
        assert box.identity.isprintable()
        box.status  # noqa: B018
        box.program(_SWEEP, 2)
    finally:
        pulsestreamer.JsonRpc = usual  # type: ignore[misc]


def _pulsestreamer(data: bytes) -> None:
    answers = Answers(data)

    def exchange(body: bytes) -> bytes:
        try:
            return answers.next()
        except serial.SerialException:
            raise DeviceDisconnected("box: gone") from None

    _use_box(exchange, answers.clock)


def _box() -> list[bytes]:
    model, clock, noted = PulseStreamerModel(), VirtualClock(), []

    def exchange(body: bytes) -> bytes:
        asked = json.loads(body)
        result = model.call(asked["method"], asked["params"], clock.now_ns() / NS_PER_S)
        clock.sleep(1e-3)
        noted.append(json.dumps({"jsonrpc": "2.0", "id": 1, "result": result}).encode())
        return noted[-1]

    _use_box(exchange, clock)
    return [pack(noted)]


# Strings of USB descriptors


def _strings(data: bytes) -> None:
    """A device whose strings are the answers of an input."""
    texts = [each.decode("utf-16-le", "replace") for each in unpack(data)]

    class Device:
        bus, address, port_numbers, iSerialNumber, iProduct = 1, 2, (1, 2), 1, 2  # noqa: N815

    usual_string, usual_find, usual_free = usb.util.get_string, usb.core.find, usb.util.dispose_resources
    usb.util.get_string = lambda device, index: texts[index - 1] if index <= len(texts) else None
    usb.core.find = lambda **_: [Device()]
    usb.util.dispose_resources = lambda device: None
    try:
        for one in attached(UsbId("board", 1, 2, ("SPB1",)), object()):
            assert f"{one.address}{one.product_name}".isprintable(), "an address that a terminal cannot show"
    finally:
        usb.util.get_string, usb.core.find, usb.util.dispose_resources = usual_string, usual_find, usual_free


# Seeds: what the emulated devices answer


class _Noting:
    """A model of a device whose answers to each write are noted."""

    def __init__(self, model: Any, clock: VirtualClock) -> None:
        self._model, self.clock, self.noted = model, clock, []
        self.in_waiting = 0
        self._came = bytearray()

    def write(self, data: bytes) -> None:
        now_s = self.clock.now_ns() / NS_PER_S
        answer = self._model.receive(data, now_s)
        for _ in range(20):
            self.clock.sleep(0.005)
            answer += self._model.tick(self.clock.now_ns() / NS_PER_S)
        self.noted.append(bytes(answer))
        self._came += answer
        self.in_waiting = len(self._came)

    read, fileno, close = Port.read, Port.fileno, Port.close


def _serial_seed(model: Any, slot: str, use: Callable[[Surroundings], object]) -> list[bytes]:
    clock = VirtualClock()
    port = _Noting(model, clock)
    use(Surroundings(clock, None, 0, {slot: Endpoint("/dev/seed", serial_port=lambda: port)}))
    return [pack(port.noted)]


def _use_laser(make: Any, config: Any, surroundings: Surroundings) -> None:
    made = make.create(config.model_validate({"port": "emulated:laser", "max_power": "80 mW"}), surroundings)
    made.status  # noqa: B018
    with suppress(DeviceError):
        made.arm(0.01)
    with suppress(DeviceError):
        made.pause()
    made.close()


def _use_sync(make: Any, config: Any, surroundings: Surroundings) -> None:
    made = make(config.model_validate({"port": "emulated:sync"}), surroundings)
    made.status  # noqa: B018
    made.program(_SWEEP, 2)
    made.gate_low()
    made.close()


@cache
def _seeds(kind: str) -> list[bytes]:
    lasers: dict[str, tuple[Any, Any]] = {
        "cobolt": (CoboltModel, partial(_use_laser, cobolt, cobolt.CoboltConfig)),
        "obis": (ObisModel, partial(_use_laser, obis, obis.ObisConfig)),
        "ibeam": (IbeamModel, partial(_use_laser, ibeam, ibeam.IbeamConfig)),
    }
    if kind in lasers:
        model, use = lasers[kind]
        return _serial_seed(model(), "laser", use)
    if kind == "prawndo":
        return _serial_seed(PrawnDoModel(), "sync", partial(_use_sync, PrawnDo, PrawnDoConfig))
    (seed,) = _serial_seed(TeensyModel(), "sync", partial(_use_sync, Teensy, TeensyConfig))
    lines = [line for answer in unpack(seed) for line in answer.splitlines()]
    return [pack([line[10:].rpartition(b" *")[0] for line in lines if line.startswith(b"#")])]


def _numbers(*values: int) -> list[bytes]:
    """Answers of a LaserCube to questions for numbers."""
    return [(b"\x00\x00" + value.to_bytes(4, "little")).ljust(64, b"\0") for value in values]


def _dream(command: bytes) -> bytes:
    return struct.pack("<cc3BxHHH2I", b"a", command, 0, 0, 0, 0, 0, 0, 0, 0).ljust(22, b"\0")


_HELIOS = [b"\x84\x06\0\0\0", b"", b"\x85Helios 1\0", b"", b"\x83\x01", b"", b""]
_CUBE = _numbers(0, 0, 1, 2, 30_000, 768, 0, 4095, 700, 0, 30_000, 0, 0)
_SPAD = [b"SPAD512S ready",
         b"Master: 1\nSlave: 2\nSoftware: 3\nFirmware: 4\nHardware: 5\nFlavour: 512S\nIntensity: 1DONE",
         b"20.5,21,22,23,1e6,97700DONE", b"DONE"]  # fmt: skip
_WORDS = (b"\r\n", b"OK", b"ok", b"error", b"ERR", b"-1", b"1e999", b"nan", b"\xff", b"\x1b[2J", b":", b"0", b"1")


def _target(name: str, parse: Callable[[bytes], object], seeds: Callable[[], Sequence[bytes]]) -> Target:
    return Target(name, seeds, parse, (DeviceError,), changes=Changes(words=_WORDS, tree=ANSWERS))


ANSWERS = Tree(lambda data: list(unpack(data)), pack)


TARGETS = (
    *(
        _target(name, partial(_laser, make, config), partial(_seeds, name))
        for name, make, config in (
            ("cobolt", cobolt, cobolt.CoboltConfig),
            ("obis", obis, obis.ObisConfig),
            ("ibeam", ibeam, ibeam.IbeamConfig),
        )
    ),
    _target("prawndo", partial(_sync, PrawnDo, PrawnDoConfig, Port), partial(_seeds, "prawndo")),
    _target("teensy", partial(_sync, Teensy, TeensyConfig, TaggedPort), partial(_seeds, "teensy")),
    _target("pulsestreamer", _pulsestreamer, _box),
    _target("helios", _helios, lambda: [pack(_HELIOS)]),
    _target("lasercube", _lasercube, lambda: [pack(_CUBE)]),
    _target(
        "etherdream", _etherdream, lambda: [pack([_dream(b"?"), b"v2".ljust(32, b"\0"), _dream(b"p"), _dream(b"?")])]
    ),
    _target("spad512s", _spad512s, lambda: [pack(_SPAD)]),
    _target("spb-usb", _spb_usb, _board),
    _target("usb-strings", _strings, lambda: [pack(["1234".encode("utf-16-le"), "SPB1 board".encode("utf-16-le")])]),
)
