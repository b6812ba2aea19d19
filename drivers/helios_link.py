"""Commands of a Helios laser DAC over its USB link (hardware.md 3.1; firmware v6, `Grix/helios_dac` 0952a2a).

Endpoints of alternate setting 1: interrupt OUT 0x06 commands, interrupt IN 0x83 replies, bulk OUT 0x02 frames.
Only the opcodes below exist here: DE would jump to the bootloader, 06 wears the flash, and 02 is sent with 0 only.
"""

import struct
import threading

from drivers.clock import Clock
from drivers.errors import DeviceTimeout, ProtocolError
from drivers.transports.usb_device import UsbDevice, UsbId

HELIOS = UsbId("Helios laser DAC", 0x1209, 0xE500)
INTERFACE, DISABLED, ENABLED = 0, 0, 1
"""The only interface; its alternate settings without and with endpoints: the firmware's 'disable' and 'enable'."""

_COMMANDS, _REPLIES, _FRAMES = 0x06, 0x83, 0x02
_REPLY_BYTES = 32
_STOP, _SHUTTER, _STATUS, _VERSION, _NAME, _SDK_VERSION = 0x01, 0x02, 0x03, 0x04, 0x05, 0x07
_OUR_SDK_VERSION = 11
"""Of the vendor's library whose frames these are."""

_STATUSES = {b"\x83\x01": True, b"\x83\x00": False}

_COMMAND_S = 0.1
"""The vendor's 16 ms are too short for slow hosts (pull request 10)."""
_FRAME_S = 0.5
_SETTLE_S = 0.1
"""From entering alternate setting 1 to the first command."""
_DRAIN_S = 0.005
_AFTER_STOP_S = 0.15
"""Frames within 100 ms of STOP are refused."""


class HeliosLink:
    """Commands, one at a time. Any thread."""

    def __init__(self, link: UsbDevice, clock: Clock) -> None:
        """Wait until the firmware is enabled, drop old replies, learn version and name."""
        self.name = link.label
        self._link = link
        self._clock = clock
        self._lock = threading.RLock()
        self._out_of_step = False
        """A reply came late or was another's: what is read next may answer an older question."""
        clock.sleep(_SETTLE_S)
        link.drain(_REPLIES, _REPLY_BYTES, _DRAIN_S)
        (version,) = struct.unpack("<I", self._ask(_VERSION, 0x84, 4)[:4])
        self.firmware: int = version
        self._send(_SDK_VERSION, _OUR_SDK_VERSION)
        self.stored_name = self._ask(_NAME, 0x85, 1).split(b"\0")[0].decode("ascii", "replace")

    def free(self) -> bool | None:
        """Whether a frame can be sent; None where the device gave no proper status, which means no as well."""
        with self._lock:
            try:
                if self._out_of_step:
                    self._link.drain(_REPLIES, _REPLY_BYTES, _DRAIN_S)
                self._out_of_step = True
                self._send(_STATUS, 0)
                answer = _STATUSES.get(self._link.read(_REPLIES, _REPLY_BYTES, _COMMAND_S))
                self._out_of_step = answer is None
            except DeviceTimeout:
                return None
        return answer

    def send_frame(self, frame: bytes) -> None:
        """One frame, after `free` said True."""
        with self._lock:
            self._link.write(_FRAMES, frame, _FRAME_S)

    def stop(self) -> None:
        """Blank at once, centre the mirror in one jump 100 ms later; returns when frames are taken again."""
        self._send(_STOP, 0)
        self._clock.sleep(_AFTER_STOP_S)

    def close(self) -> None:
        """Stop, shutter pin low (the firmware never lowers it), back to 'disabled', and the USB device given back."""
        try:
            self.stop()
            self._send(_SHUTTER, 0)
            self._link.set_alternate(INTERFACE, DISABLED)
        finally:
            self._link.close()

    def _send(self, opcode: int, data: int) -> None:
        with self._lock:
            self._link.write(_COMMANDS, bytes((opcode, data)), _COMMAND_S)

    def _ask(self, opcode: int, answer: int, least: int) -> bytes:
        """What follows the answer's first byte. Two questions with three reads each, as in the vendor's library."""
        heard = b""
        with self._lock:
            for _ in range(2):
                self._send(opcode, 0)
                for _ in range(3):
                    try:
                        heard = self._link.read(_REPLIES, _REPLY_BYTES, _COMMAND_S)
                    except DeviceTimeout:
                        break
                    if heard[:1] == bytes((answer,)) and len(heard) > least:
                        return heard[1:]
        if not heard:
            raise DeviceTimeout(f"{self.name}: no answer to command {opcode:02x}; unplug it and plug it in again")
        raise ProtocolError(
            f"{self.name}: answered command {opcode:02x} with {heard[:8].hex(' ')}; this is no Helios firmware"
        )
