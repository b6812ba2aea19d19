"""The receiving end of a live SPB1 stream (docs/reference/spb1-usb.md): queued reads straight into ring slots.

Reads of one stride each are kept in flight, into slots claimed in order. A block is used in place, without a copy, or
refused and counted. After damage, the next sound header on a multiple of 1024 bytes shows where blocks begin, and one
short read aligns the reads with the blocks again. If the ring has no free slot, reads go on into spare memory so that
the device's FIFO does not overflow. Such a block is copied into a slot if one has become free meanwhile, else dropped
and counted.
"""

import logging
from collections import deque
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from drivers.errors import CorruptBlock
from drivers.frames import BlockFlag, FrameBlock, packed_row_bytes
from drivers.ring import BlockRing
from drivers.spb1.layout import ALIGN, HEADER_BYTES, MAGIC
from drivers.spb1.reader import HeaderFields, read_frames, read_header
from drivers.transports.bulk_link import Buffer, BulkLink

_log = logging.getLogger(__name__)

QUEUE_BYTES = 8 << 20
"""Total size of the reads in flight: what the fastest link brings in 20 ms, by which a busy host may be late. It is
half of what Linux grants by default."""
MOST_READS, FEWEST_READS = 64, 4
_WORD_PX = 64
_LAST, _LOST_BEFORE, _FORCED_LOW = (
    int(flag) for flag in (BlockFlag.LAST, BlockFlag.LOST_BEFORE, BlockFlag.GATE_FORCED_LOW)
)
"""Plain integers: arithmetic with flags takes microseconds, and there is much of it in each block."""
_ROOMY_RING = 8
"""With a ring of at least this many slots, two reads are kept in flight even while the ring is full; else one."""


@dataclass(frozen=True, slots=True)
class Armed:
    """Properties that the blocks of a run must have. n_frames: frames of the whole run; None: it has no set end.
    check_payload: whether CRCs of payloads are checked."""

    run_id: int
    stride: int
    width: int
    height: int
    sensor_width: int
    sensor_height: int
    n_frames: int | None
    check_payload: bool


class ReadOutcome(Enum):
    """Outcomes of a read."""

    NOTHING = "nothing came in time"
    CONTROL = "a control block, or what is left over from another run"
    REFUSED = "damaged, counted"
    FRAMES = "a block of frames, published or dropped"


@dataclass(slots=True)
class _Item:
    """A read in flight. slot: whether it goes into a claimed ring slot, in the order of claiming; use: whether its data
    is used.
    """

    buffer: Buffer
    slot: bool
    use: bool = True


class BlockReceiver:
    """The stream of one run. For use by one thread at a time."""

    def __init__(self, link: BulkLink, endpoint: int, armed: Armed, label: str) -> None:
        self.delivered = 0
        self.next_frame = 0
        """One more than the number of the last frame that is known to have been exposed."""
        self.crc_errors = 0
        """Blocks refused: damaged, out of order or of another geometry."""
        self.resyncs = 0
        self.ended = False
        """Whether the run's last block came."""
        self.gate_forced_low = False
        """Whether the device's watchdog ended the run."""
        self._link = link
        self._endpoint = endpoint
        self._armed = armed
        self._label = label
        self._depth = max(FEWEST_READS, min(MOST_READS, QUEUE_BYTES // armed.stride))
        self._items: deque[_Item] = deque()
        self._held: Buffer | None = None
        """A claimed slot for which the system accepted no read yet."""
        self._spares: list[Buffer] = [np.zeros(armed.stride, np.uint8) for _ in range(2)]
        self._ring: BlockRing | None = None
        self._last_seq = -1
        self._published = 0
        self._lost_at_last = 0
        """Frames that were lost in the run before the last published block."""
        self._realign = 0
        """Bytes to read until the next read begins where a block begins."""
        self._row_px = 8 * packed_row_bytes(armed.sensor_width)

    def take(self, ring: BlockRing, timeout_s: float) -> ReadOutcome:
        """Wait for the next read and process it. Raises the link's errors, `UnsupportedBlock`, and what
        `ring.mark_overflow` raises; the frames are counted before that."""
        self._ring = ring
        self._top_up(ring)
        reaped = self._link.reap(timeout_s)
        if reaped is None:
            return ReadOutcome.NOTHING
        item = self._items.popleft()
        if not item.use or not reaped[1]:  # a packet of 0 bytes is no block, only the end of a transfer
            self._give_back(item)
            return ReadOutcome.CONTROL
        return self._judge(item, item.buffer[: reaped[1]])

    def drain(self, timeout_s: float) -> bool:
        """Read one more block and drop it, waiting at most `timeout_s`; its frames count as exposed. Returns whether
        the run's last block has come."""
        if not self._items:
            self._submit(self._spare(), slot=False)
        reaped = self._link.reap(timeout_s)
        if reaped is not None:
            item = self._items.popleft()
            try:
                fields = read_header(item.buffer[: reaped[1]])
                if not fields.is_control and fields.block.run_id == self._armed.run_id:
                    self._note(fields, fields.n_frames)
            except CorruptBlock:
                pass  # nothing of it is used
            self._give_back(item)
        return self.ended

    def close(self) -> None:
        """Cancel the reads in flight and give their slots back to the ring."""
        self._link.cancel()
        if self._held is not None:
            self._items.append(_Item(self._held, slot=True))
            self._held = None
        while self._items:
            self._give_back(self._items.popleft())

    def _top_up(self, ring: BlockRing) -> None:
        """Keep as many reads in flight as the ring has slots for, at most `_depth`; one or two in any case."""
        fewest = 2 if ring.slots >= _ROOMY_RING else 1
        if self._realign:
            if not self._submit(self._spare()[: self._realign], slot=False, use=False):
                return
            self._realign = 0
        while len(self._items) < self._depth:
            if self._held is None:
                self._held = ring.claim(0.0)
            if self._held is None:
                if len(self._items) >= fewest or not self._submit(self._spare(), slot=False):
                    return
            elif self._submit(self._held[: self._armed.stride], slot=True):
                self._held = None
            else:
                self._depth = len(self._items)  # the system takes no more; asking again would only cost time

    def _submit(self, buffer: Buffer, *, slot: bool, use: bool = True) -> bool:
        if not self._link.submit(self._endpoint, buffer):
            if not slot:
                self._spares.append(buffer)
            return False
        self._items.append(_Item(buffer, slot, use))
        return True

    def _spare(self) -> Buffer:
        while self._spares:
            if len(spare := self._spares.pop()) == self._armed.stride:
                return spare
        return np.zeros(self._armed.stride, np.uint8)

    def _give_back(self, item: _Item) -> None:
        if not item.slot:
            self._spares.append(item.buffer)
        elif self._ring is not None:
            self._ring.discard()

    def _judge(self, item: _Item, data: Buffer) -> ReadOutcome:
        took = ReadOutcome.CONTROL
        try:
            fields = read_header(data)
            if not fields.is_control and fields.block.run_id == self._armed.run_id:
                self._require_armed(fields)
                block = read_frames(data, fields, check_payload=self._armed.check_payload)
                self._require_windows(block)
                self._note(fields, block.n_frames)
                took = ReadOutcome.FRAMES if block.n_frames else ReadOutcome.CONTROL
        except CorruptBlock as error:
            self.crc_errors += 1
            _log.warning("%s: block refused: %s", self._label, error)
            self._find_step(data)
            took = ReadOutcome.REFUSED
        finally:
            if took is not ReadOutcome.FRAMES:
                self._give_back(item)
        if took is ReadOutcome.FRAMES:
            self._hand_over(item, fields, block)
        return took

    def _require_armed(self, fields: HeaderFields) -> None:
        """Raise CorruptBlock for a sound block that cannot be the next of this run."""
        block, armed = fields.block, self._armed
        found = (block.width, block.height, block.sensor_width, block.sensor_height)
        if found != (armed.width, armed.height, armed.sensor_width, armed.sensor_height):
            raise CorruptBlock(f"block {block.block_seq}: geometry {found} is not the one that was armed")
        if block.block_seq <= self._last_seq or block.first_frame < self.next_frame:
            raise CorruptBlock(
                f"block {block.block_seq} from frame {block.first_frame} on comes after block {self._last_seq} and "
                f"frame {self.next_frame - 1}"
            )
        if armed.n_frames is not None and block.first_frame + fields.n_frames > armed.n_frames:
            raise CorruptBlock(f"block {block.block_seq} reaches beyond the {armed.n_frames} frames of the run")

    def _require_windows(self, block: FrameBlock) -> None:
        """Raise CorruptBlock unless all windows start on a 64-bit word and lie within the row: the counting relies on
        both."""
        if block.n_frames == 0:
            return
        x0 = block.records["x0"]
        if self._armed.width == self._armed.sensor_width:
            bad = bool(x0.any())
        else:
            bad = int(x0.max()) + self._armed.width > self._row_px or int(np.bitwise_or.reduce(x0)) % _WORD_PX != 0
        if bad:
            raise CorruptBlock(f"block {block.header.block_seq}: a window lies beyond the row or off its words")

    def _note(self, fields: HeaderFields, n_frames: int) -> None:
        """Note how far the run has come by this block: its number, its last frame and its flags."""
        block = fields.block
        self._last_seq = max(self._last_seq, block.block_seq)
        self.next_frame = max(self.next_frame, block.first_frame + n_frames)
        flags = int(block.flags)
        self.ended = self.ended or bool(flags & _LAST)
        self.gate_forced_low = self.gate_forced_low or bool(flags & _FORCED_LOW)

    def _hand_over(self, item: _Item, fields: HeaderFields, block: FrameBlock) -> None:
        """Publish the block; one that came into spare memory is copied into a slot first, or dropped."""
        assert self._ring is not None, "set by take"
        if not item.slot:
            copied = self._copied(fields, item.buffer)
            self._spares.append(item.buffer)
            if copied is None:
                self._ring.mark_overflow(block.n_frames)
                return
            block = copied
        block = self._as_received(block)
        self._ring.publish(block)
        self._lost_at_last = block.header.lost_before
        self.delivered += block.n_frames
        self._published += 1

    def _copied(self, fields: HeaderFields, buffer: Buffer) -> FrameBlock | None:
        """The block, copied into a slot. None if no slot is free, or if reads in flight hold slots, since slots must be
        published in order.
        """
        assert self._ring is not None, "set by take"
        if self._held is not None or any(item.slot for item in self._items):
            return None
        memory = self._ring.claim(0.0)
        if memory is None:
            return None
        np.copyto(memory[: len(buffer)], buffer)
        return read_frames(memory, fields, check_payload=False)

    def _as_received(self, block: FrameBlock) -> FrameBlock:
        """The block with its number and losses corrected for the blocks that this receiver refused or dropped."""
        header = block.header
        lost = header.first_frame - self.delivered
        flags = int(header.flags) & ~_LOST_BEFORE | (_LOST_BEFORE if lost > self._lost_at_last else 0)
        if (header.block_seq, header.lost_before, int(header.flags)) == (self._published, lost, flags):
            return block
        header = replace(header, block_seq=self._published, lost_before=lost, flags=BlockFlag(flags))
        return replace(block, header=header)

    def _find_step(self, data: Buffer) -> None:
        """Look for a sound header inside a damaged read. If there is one, blocks now begin there in every read, so the
        reads in flight are dropped and later ones realigned.
        """
        for offset in range(ALIGN, len(data) - HEADER_BYTES + 1, ALIGN):
            if data[offset : offset + len(MAGIC)].tobytes() != MAGIC:
                continue
            try:
                read_header(data[offset:])
            except CorruptBlock:
                continue
            self.resyncs += 1
            _log.warning("%s: blocks begin %d bytes later from here on", self._label, offset)
            for item in self._items:
                item.use = False
            self._realign = offset
            return
