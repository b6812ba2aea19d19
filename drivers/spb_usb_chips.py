"""The USB chips of SPB1 boards: ids, endpoints, and the session that an FT601 wants (hardware.md sections 2.4 and 2.5).

Sources there: `VicidominiLab` BrightEyes-TTM 8f8d8d8 (FX3 with the AN65974 firmware, 04B4:00F1, bulk IN 0x81);
`apertus-open-source-cinema/ft60x-rs` and `lambdaconcept/ft60x_driver` (0403:601F, session commands on 0x01, stream on
0x82). Both ids are shared by unrelated gear, so the product string must fit too.
"""

import struct
from dataclasses import dataclass
from typing import Literal

from drivers.errors import ProtocolError
from drivers.transports.bulk_link import BulkLink
from drivers.transports.usb_device import UsbId

Chip = Literal["fx3", "ft601"]

LABEL = "SPB1 SPAD"
_SESSION_OUT = 0x01
_COMMAND = struct.Struct("<IBBHIII")
"""index, pipe, command, 0, length, 0, 0 (section 2.5)."""
_ABORT, _STREAM, _CLEAR = 0, 2, 3
_STREAM_BYTES = 1 << 20
_CONFIG_REQUEST, _CONFIG_BYTES = 0xCF, 152


@dataclass(frozen=True, slots=True)
class Wiring:
    """Which endpoint is what on a chip. ack_in: not on every board."""

    usb: UsbId
    interfaces: tuple[int, ...]
    command_out: int
    stream_in: int
    ack_in: int
    has_session: bool = False

    def open_session(self, link: BulkLink) -> None:
        """The FT601 streams only after it was told to; data of a session that was not closed is cleared first."""
        if not self.has_session:
            return
        found = len(link.control_in(0xC0, _CONFIG_REQUEST, 1, 0, _CONFIG_BYTES, 1.0))
        if found != _CONFIG_BYTES:
            raise ProtocolError(f"{link.label}: an FT601 has {_CONFIG_BYTES} bytes of configuration, not {found}")
        for command in (_CLEAR, _STREAM):
            self._tell(link, command)

    def close_session(self, link: BulkLink) -> None:
        """Without it the FT601 answers nobody until it is plugged in anew."""
        if self.has_session:
            for command in (_ABORT, _CLEAR):
                self._tell(link, command)

    def _tell(self, link: BulkLink, command: int) -> None:
        """To each pipe in use: touching others disturbs the session (LeechCore pull requests 80 and 81)."""
        for pipe in sorted({self.stream_in, self.ack_in} & link.endpoints):
            length = _STREAM_BYTES if command == _STREAM else 0
            link.write(_SESSION_OUT, _COMMAND.pack(0, pipe, command, 0, length, 0, 0), 1.0)


WIRINGS: dict[Chip, Wiring] = {
    "fx3": Wiring(UsbId(LABEL, 0x04B4, 0x00F1, "SPB1"), (0,), 0x01, 0x81, 0x82),
    "ft601": Wiring(UsbId(LABEL, 0x0403, 0x601F, "SPB1"), (0, 1), 0x02, 0x82, 0x83, has_session=True),
}
USB_IDS = tuple(wiring.usb for wiring in WIRINGS.values())
"""What such boards say they are on the bus."""
