"""Faults on the way between a USB host and a device model, as `faults.FaultSchedule` decides them.

Replies (IN): late, split into two transfers, merged, cut, corrupt, repeated, lost, paused, unplugged, hung. Transfers
to the device (OUT): late (not taken for a while), lost (taken and never seen by the firmware), stalled (EPIPE until the
endpoint is cleared), unplugged, hung; the bus's own checksums leave no other. Control transfers pass unharmed.
"""

from collections import deque

from sim_backend.wire.serve.usb_model import STALL, Answer, Setup, Stall, UsbModel
from sim_backend.wire.serve.wire_server import Fault, FaultSchedule

_OUT_FAULTS = (Fault.LATE, Fault.LOST, Fault.STALL, Fault.UNPLUG, Fault.HANG)


class FaultyUsb(UsbModel):
    """A model behind a bad cable. A transfer that was not taken (NAK) is not struck again when it is offered again."""

    def __init__(self, model: UsbModel, schedule: FaultSchedule, late_s: float = 0.05) -> None:
        self.spec = model.spec
        self._model = model
        self._schedule = schedule
        self._late_s = late_s
        self._silent_until_s = 0.0
        self._hung = False
        self._arriving: dict[int, deque[tuple[float, bytes]]] = {}
        self._offered: tuple[int, int, float] | None = None
        """endpoint, length and earliest time of a transfer that waits to be taken."""

    def set_interface(self, interface: int, alternate: int, now_s: float) -> None:
        self._arriving.clear()
        self._offered = None
        self._model.set_interface(interface, alternate, now_s)

    def control(self, setup: Setup, data: bytes, now_s: float) -> Answer:
        return None if self._hung else self._model.control(setup, data, now_s)

    def unplugged(self, now_s: float) -> None:
        self._model.unplugged(now_s)

    def out(self, endpoint: int, data: bytes, now_s: float) -> int | Stall | None:
        if self._hung or now_s < self._silent_until_s:
            return None
        if self._offered is None or self._offered[:2] != (endpoint, len(data)):
            fault = self._schedule.next()
            fault = fault if fault in _OUT_FAULTS else None
            self._strike(fault, now_s)
            if fault is Fault.STALL:
                return STALL
            if fault is Fault.LOST:
                return len(data)
            self._offered = (endpoint, len(data), now_s + (self._late_s if fault is Fault.LATE else 0.0))
        if self._hung or self.gone or now_s < self._offered[2]:
            return None
        taken = self._model.out(endpoint, data, now_s)
        if taken is not None:
            self._offered = None
        return taken

    def inp(self, endpoint: int, length: int, now_s: float) -> Answer:
        answer = None if self._hung else self._model.inp(endpoint, length, now_s)
        if isinstance(answer, Stall):
            return answer
        queue = self._arriving.setdefault(endpoint, deque())
        if answer is not None:
            fault = self._schedule.next()
            self._strike(fault, now_s)
            if fault is Fault.STALL:
                self._silent_until_s = now_s + self._schedule.stall_s
            queue.extend((now_s + one.delay_s, one.data) for one in self._schedule.shape(fault, bytes(answer)))
        if not queue or queue[0][0] > now_s or now_s < self._silent_until_s or self._hung or self.gone:
            return None
        return queue.popleft()[1]

    def _strike(self, fault: Fault | None, now_s: float) -> None:
        if fault is Fault.UNPLUG:
            self.gone = True
        elif fault is Fault.HANG:
            self._hung = True
