"""Random faults on the wire of an SPB1 device: every sequence ends in right frames, counted, or in one of our errors.

Blocks and acknowledgements come late, cut, merged with what follows, with flipped bits, twice, out of order or never;
the firmware hangs, stalls an endpoint or is unplugged, at a random moment. A run that ends without an error has nothing
but right frames, and counters that add up to what the device exposed.
"""

import random
from collections.abc import Callable, Iterable
from fractions import Fraction

from drivers.clock import NS_PER_S, VirtualClock
from drivers.errors import DeviceTimeout
from drivers.frames import FrameBlock
from drivers.interfaces import SpadRequest
from drivers.ring import BlockRing
from drivers.spads.spb_usb import SpbUsb
from sim_backend.wire.firmware.spb_usb import SpbUsbModel
from sim_backend.wire.firmware.spb_usb_run import SpbUsbBoard
from sim_backend.wire.serve.usb import EmulatedUsb
from sim_backend.wire.serve.usb_model import STALL, Answer
from tests.campaigns.outcomes import Ending, ending
from tests.wire.spb_device import HEIGHT, WIDTH, NumberedSource, on_bus, require_right

REQUEST = SpadRequest(Fraction(100_000), 1e-5, "stream", block_frames=4)
FILL_S = 0.3
DEADLINE_S = 12.0


class FaultyModel(SpbUsbModel):
    """A device whose every transfer may go wrong, from the moment `armed` is set."""

    def __init__(self, rng: random.Random, probability: float, most: int, **settings: object) -> None:
        super().__init__(NumberedSource(), SpbUsbBoard(WIDTH, HEIGHT, **settings))  # type: ignore[arg-type]
        self._rng = rng
        self._probability = probability
        self._left = most
        self._silent_until = 0.0
        self._held: list[bytes] = []
        self.struck: list[str] = []
        self.unplug_now = False
        self.mangle = self._damage

    def _strikes(self, kinds: tuple[str, ...]) -> str:
        if self._left <= 0 or self._rng.random() >= self._probability:
            return ""
        self._left -= 1
        kind = self._rng.choice(kinds)
        self.struck.append(kind)
        return kind

    def _damage(self, block: memoryview) -> Iterable[bytes | memoryview]:
        """Pieces that a block of the stream comes in, perhaps damaged."""
        held, self._held = self._held, []
        kind = self._strikes(("flip", "cut", "lost", "twice", "swapped", "zeros", "burst of flips"))
        data = bytearray(block)
        if kind == "flip":
            data[self._rng.randrange(len(data))] ^= 1 << self._rng.randrange(8)
        elif kind == "burst of flips":
            at = self._rng.randrange(len(data))
            data[at : at + 64] = self._rng.randbytes(len(data[at : at + 64]))
        elif kind == "cut":
            del data[1024 * self._rng.randrange(1, max(2, len(data) // 1024)) :]
        elif kind == "lost":
            data.clear()
        elif kind == "twice":
            return (bytes(data), bytes(data), *held)
        elif kind == "swapped":
            self._held = [bytes(data)]
            return held
        elif kind == "zeros":
            return (bytes(1024 * self._rng.randrange(1, 9)), bytes(data), *held)
        return (bytes(data), *held) if kind else (block, *held)

    def inp(self, endpoint: int, length: int, now_s: float) -> Answer:
        """Acknowledgements and transfers as a whole go wrong too."""
        if now_s < self._silent_until:
            return None
        answer = super().inp(endpoint, length, now_s)
        if not isinstance(answer, bytes | memoryview):
            return answer
        kind = (
            self._strikes(("late", "hang", "stall", "unplug", "short", "ack flip")) if self._rng.random() < 0.2 else ""
        )
        if kind == "late":
            self._silent_until = now_s + self._rng.uniform(0.0, 0.2)
        elif kind == "hang":
            self.deaf = True
        elif kind == "stall":
            return STALL
        elif kind == "unplug":
            self.unplug_now = True
        elif kind == "short" and len(answer) > 1:
            return answer[: self._rng.randrange(1, len(answer))]
        elif kind == "ack flip" and len(answer) == 16:
            data = bytearray(answer)
            data[self._rng.randrange(16)] ^= 1 << self._rng.randrange(8)
            return bytes(data)
        return answer


def sequence(seed: int) -> Ending:
    rng = random.Random(seed)
    chip = rng.choice(("fx3", "ft601"))
    device = FaultyModel(
        rng, rng.choice((0.02, 0.1, 0.5)), rng.randrange(1, 8), chip=chip, acks=rng.choice(("endpoint", "stream"))
    )
    clock = VirtualClock()
    ended = ending(lambda: _open_and_run(device, rng, clock), lambda: clock.now_ns() / NS_PER_S, DEADLINE_S)
    return ended._replace(struck=device.struck)


def _open_and_run(device: FaultyModel, rng: random.Random, clock: VirtualClock) -> str:
    bus = EmulatedUsb(clock)
    attached = bus.plug(device)
    with on_bus(bus, chip=device.chip, test_pattern=rng.random() < 0.3) as spad:
        for _ in range(2):
            n_frames = rng.randrange(1, 200)
            timing = spad.configure(REQUEST)
            ring = BlockRing(100, timing.stride)
            reader = ring.reader("campaign")
            spad.start(n_frames)
            try:
                _fill_to_the_end(spad, ring, lambda: attached.unplug() if device.unplug_now else None)
            finally:
                spad.stop()
                ring.finish()
                assert not ring._claimed, f"{len(ring._claimed)} slots are still claimed"
                blocks = list(reader)
                numbers = require_right(blocks)
                _require_counted(spad, blocks, numbers)
            assert spad.counters.exposed == n_frames, f"exposed {spad.counters.exposed} of {n_frames} frames"
    return "complete"


def _fill_to_the_end(spad: SpbUsb, ring: BlockRing, between: Callable[[], object]) -> None:
    """Fill as the application does: two silences in a row are the end."""
    silences = 0
    while True:
        between()
        try:
            if not spad.fill(ring, FILL_S):
                return
            silences = 0
        except DeviceTimeout:
            silences += 1
            if silences > 1:
                raise


def _require_counted(spad: SpbUsb, blocks: list[FrameBlock], numbers: list[int]) -> None:
    counters = spad.counters
    assert counters.delivered == len(numbers), "delivered frames are miscounted"
    assert counters.exposed == counters.delivered + (counters.lost or 0), "counters do not add up"
    delivered = 0
    for block in blocks:
        assert block.header.lost_before == block.header.first_frame - delivered, "a gap is not in the header"
        delivered += block.n_frames
