"""What emulated scanner boards have in common: commands and replies, points, a record of what the outputs did."""

from collections import deque

from sim_backend.wire.dac_history import DacHistory
from sim_backend.wire.usb_descriptors import DeviceSpec
from sim_backend.wire.usb_model import STALL, Answer, Stall, UsbModel

DAC_STEPS = 4095
CENTRE = 0x800


def normal(value: int) -> float:
    """The normalised drive of a value of the DAC."""
    return value / DAC_STEPS * 2 - 1


class DacModel(UsbModel):
    """Base of the boards. `history` is what its outputs did; times are the transport's."""

    def __init__(self, spec: DeviceSpec, *, commands: int, replies: int, points: int) -> None:
        """commands, replies, points: its endpoints."""
        self.spec = spec
        self.history = DacHistory(normal(CENTRE), lines=4)
        self.deaf = False
        """Test knob: the firmware hangs, its outputs play on."""
        self.points_endpoint = points
        self._commands_endpoint, self._replies_endpoint = commands, replies
        self._replies: deque[bytes] = deque()

    def leave_reply(self, reply: bytes) -> None:
        """A reply that an earlier program never read."""
        self._replies.append(reply)

    def out(self, endpoint: int, data: bytes, now_s: float) -> int | Stall | None:
        """Commands and points."""
        self.advance(now_s)
        if self.deaf:
            return None
        if endpoint == self._commands_endpoint:
            self._command(data, now_s)
            return len(data)
        return self._take_points(data, now_s) if endpoint == self.points_endpoint else STALL

    def inp(self, endpoint: int, length: int, now_s: float) -> Answer:
        """Replies, one a transfer."""
        self.advance(now_s)
        ready = endpoint == self._replies_endpoint and self._replies and not self.deaf
        return self._replies.popleft() if ready else None

    def unplugged(self, now_s: float) -> None:
        """No power: the outputs fall to 0 V, which is the centre."""
        self.advance(now_s)
        self._halt(now_s)
        self.history.cut(now_s, normal(CENTRE))

    def moving(self, now_s: float) -> bool:
        """Whether points are being played."""
        raise NotImplementedError

    def advance(self, now_s: float) -> None:
        """Play on until now."""
        raise NotImplementedError

    def _command(self, data: bytes, now_s: float) -> None:
        raise NotImplementedError

    def _take_points(self, data: bytes, now_s: float) -> int | None:
        """Bytes taken; None: not now."""
        raise NotImplementedError

    def _halt(self, now_s: float) -> None:
        """Nothing is left to play."""
        raise NotImplementedError
