"""A small USB device that answers what it was sent: checks a transport, with no real device behind it.

Alternate setting 0 has no endpoints. Alternate 1 of interface 0: interrupt OUT 0x06 and IN 0x83 (32 B), bulk OUT 0x02
and IN 0x81 (64 B). What goes out on 0x06 comes back on 0x83, 0x02 on 0x81. Vendor requests steer it, so that a test in
another process can.
"""

from collections import deque

from sim_backend.wire.serve.usb_model import (
    STALL,
    AlternateSpec,
    Answer,
    DeviceSpec,
    EndpointSpec,
    Setup,
    Stall,
    UsbModel,
)

ECHO_IN, STALL_BULK_IN, OVERLONG, GONE, DEAF = 0x10, 0x11, 0x12, 0x13, 0x14
"""Vendor requests: answer `value` as two bytes; stall the next read of 0x81; answer the next read of 0x83 with a whole
packet; the cable is pulled; take nothing on 0x02 any more (value 1) or again (value 0)."""

_BACK = {0x06: 0x83, 0x02: 0x81}


class LoopbackModel(UsbModel):
    """See the module."""

    def __init__(self, serial: str | None = "LOOP1") -> None:
        self.spec = DeviceSpec(
            vendor=0x1209,
            product=0x0001,
            manufacturer="spadrig",
            product_name="Loopback",
            serial=serial,
            speed="full",
            alternates=(
                AlternateSpec(0, 0),
                AlternateSpec(
                    0,
                    1,
                    (
                        EndpointSpec(0x02, "bulk", 64),
                        EndpointSpec(0x81, "bulk", 64),
                        EndpointSpec(0x06, "interrupt", 32, 1),
                        EndpointSpec(0x83, "interrupt", 32, 1),
                    ),
                ),
            ),
        )
        self.alternate = 0
        self._queues: dict[int, deque[bytes]] = {0x81: deque(), 0x83: deque()}
        self._stall = False
        self._overlong = False
        self._deaf = False

    def set_interface(self, interface: int, alternate: int, now_s: float) -> None:
        """Entering a setting forgets what was queued."""
        self.alternate = alternate
        for queue in self._queues.values():
            queue.clear()

    def control(self, setup: Setup, data: bytes, now_s: float) -> Answer:
        if setup.request == ECHO_IN:
            return setup.value.to_bytes(2, "little")
        if setup.request == STALL_BULK_IN:
            self._stall = True
        elif setup.request == OVERLONG:
            self._overlong = True
        elif setup.request == DEAF:
            self._deaf = bool(setup.value)
        elif setup.request == GONE:
            self.gone = True
        else:
            return STALL
        return b""

    def out(self, endpoint: int, data: bytes, now_s: float) -> int | Stall | None:
        if self._deaf and endpoint == 0x02:
            return None
        self._queues[_BACK[endpoint]].append(data)
        return len(data)

    def inp(self, endpoint: int, length: int, now_s: float) -> Answer:
        if endpoint == 0x81 and self._stall:
            self._stall = False
            return STALL
        if endpoint == 0x83 and self._overlong:
            self._overlong = False
            return bytes(32)
        queue = self._queues[endpoint]
        if not queue:
            return None
        data = queue.popleft()
        if len(data) > length:
            queue.appendleft(data[length:])
        return data[:length]
