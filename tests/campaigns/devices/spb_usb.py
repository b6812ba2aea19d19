"""Random faults on the USB cable of an SPB1 device: every sequence ends in right frames or in one of our errors.

A run that ends without an error has nothing but right frames, and counters that add up to what the device exposed.
"""

import random
from fractions import Fraction

from drivers.clock import VirtualClock, now_s
from drivers.errors import DeviceTimeout
from drivers.frames import FrameBlock
from drivers.interfaces import SpadRequest
from drivers.ring import BlockRing
from drivers.spads.spb_usb import SpbUsb
from sim_backend.wire.serve.usb import EmulatedUsb
from tests.campaigns.outcomes import Ending, ending
from tests.wire.faults import FaultSchedule, FaultyUsb
from tests.wire.spb_device import model, on_bus, require_right

REQUEST = SpadRequest(Fraction(100_000), 1e-5, "stream", block_frames=4)
FILL_S = 0.3
DEADLINE_S = 12.0


def sequence(seed: int) -> Ending:
    rng = random.Random(seed)
    schedule = FaultSchedule(
        seed, rng.choice((0.02, 0.1, 0.5)), skip=rng.randrange(60), most=rng.randrange(1, 8), late_s=0.2, stall_s=0.3
    )
    device = model(chip=rng.choice(("fx3", "ft601")), acks=rng.choice(("endpoint", "stream")))
    clock = VirtualClock()
    bus = EmulatedUsb(clock)
    bus.plug(FaultyUsb(device, schedule))
    ended = ending(lambda: _open_and_run(bus, device.chip, rng), lambda: now_s(clock), DEADLINE_S)
    return ended._replace(struck=[fault.value for fault in schedule.struck])


def _open_and_run(bus: EmulatedUsb, chip: str, rng: random.Random) -> str:
    with on_bus(bus, chip=chip, test_pattern=rng.random() < 0.3) as spad:
        for _ in range(2):
            n_frames = rng.randrange(1, 200)
            timing = spad.configure(REQUEST)
            ring = BlockRing(100, timing.stride)
            reader = ring.reader("campaign")
            spad.start(n_frames)
            try:
                _fill_to_the_end(spad, ring)
            finally:
                spad.stop()
                ring.finish()
                assert not ring._claimed, f"{len(ring._claimed)} slots are still claimed"
                blocks = list(reader)
                numbers = require_right(blocks)
                _require_counted(spad, blocks, numbers)
            assert spad.counters.exposed == n_frames, f"exposed {spad.counters.exposed} of {n_frames} frames"
    return "complete"


def _fill_to_the_end(spad: SpbUsb, ring: BlockRing) -> None:
    """Fill as the application does: two silences in a row are the end."""
    silences = 0
    while True:
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
