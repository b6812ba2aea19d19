"""Faults that strike a scan of the simulated rig from within its process, at drawn moments.

They act where a real one would: on the light (a mirror that stands, a laser that is dark, a sensor that is blinded), on
blocks between device and ring, on the clocks, on devices, on the disk and on memory.
"""

import errno
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceDisconnected, DeviceFault, DeviceTimeout
from drivers.frames import BlockHeader, FrameBlock
from drivers.interfaces import BeamScanner, LineLaser, SyncSource
from drivers.ring import BlockRing
from drivers.spb1 import BlockLayout, block_views, seal_block
from rig.count.volume import SweepCounter
from rig.depth.reconstruct import Reconstructor
from rig.recording.segment import OpenSegment
from rig.run_folder.folder import RunFolder
from rig.scan.scan import LiveFacts
from sim_backend.devices.spad import SimulatedSpad
from sim_backend.frames.photons import PhotonSource

Span = tuple[int, int]
SILENCE_S = 0.4
"""A SPAD that sends nothing for so long has failed, in place of 5 s."""


@dataclass
class Struck:
    """A fault, as it was drawn and as it came.

    frames: those that it altered or took away, first and last + 1; from then on if the last is None. own_end: it may
    end the run. came: whether its moment came.
    """

    name: str
    frames: list[tuple[int, int | None]] = field(default_factory=list)
    own_end: bool = False
    came: bool = False


Patches = Iterator[Any]
Fault = Callable[["Moment", Struck], Patches]


@dataclass(frozen=True)
class Moment:
    """What a fault may draw from. first: the frame at which it begins. frames: of the whole scan."""

    rng: np.random.Generator
    first: int
    frames: int

    def span(self, most: int) -> Span:
        """The first frame, and a later one."""
        return self.first, self.first + int(self.rng.integers(1, most))


@contextmanager
def struck(drawn: Sequence[tuple[str, Moment]]) -> Iterator[list[Struck]]:
    """A context in which these faults strike the scan. They are of one process: one scan at a time."""
    with ExitStack() as stack:
        stack.enter_context(patch.object(LiveFacts, "silence_s", SILENCE_S))
        found = []
        for name, moment in drawn:
            one = Struck(name)
            for each in FAULTS[name](moment, one):
                stack.enter_context(each)
            found.append(one)
        yield found


def _wrapped(of: Any, name: str, around: Callable[..., Any]) -> Any:
    """A patch of a method: `around(usual, self, *arguments)` takes its place."""
    usual = getattr(of, name)
    return patch.object(of, name, lambda self, *args, **named: around(partial(usual, self), self, *args, **named))


def _light(change: Callable[[NDArray[np.int64], Any, Any, NDArray[np.uint8]], tuple[Any, Any]]) -> Any:
    """A patch of what the SPAD sees. change: gets frame numbers, mirror positions, powers and the bits, twice: before
    the frames are drawn, when it returns positions and powers, and after."""

    def expose(usual: Any, _: Any, first: int, held: Any, power_w: Any, x0: Any, bits: Any, time_s: Any) -> None:
        numbers = (first & ((1 << 48) - 1)) + np.arange(len(held))
        held, power_w = change(numbers, held.copy(), power_w.copy(), bits[:0])
        usual(first, held, power_w, x0, bits, time_s)
        change(numbers, held, power_w, bits)

    return _wrapped(PhotonSource, "expose", expose)


def _mirror_stands(moment: Moment, one: Struck) -> Patches:
    first, end = moment.span(moment.frames)
    one.frames.append((first, end))
    stood: list[Any] = []

    def change(numbers: Any, held: Any, power_w: Any, bits: Any) -> tuple[Any, Any]:
        inside = (numbers >= first) & (numbers < end)
        if inside.any() and not len(bits):
            one.came = True
            stood.append(held[np.argmax(inside)])
            held[inside] = stood[0]
        return held, power_w

    yield _light(change)


def _laser_dark(moment: Moment, one: Struck) -> Patches:
    first, end = moment.span(moment.frames)
    one.frames.append((first, end))

    def change(numbers: Any, held: Any, power_w: Any, bits: Any) -> tuple[Any, Any]:
        inside = (numbers >= first) & (numbers < end)
        one.came |= bool(inside.any())
        power_w[inside] = 0.0
        return held, power_w

    yield _light(change)


def _blinded(moment: Moment, one: Struck) -> Patches:
    first, end = moment.span(moment.frames)
    one.frames.append((first, end))
    rows, share = moment.rng.random(2)
    pool = moment.rng.random(1 << 16) < 0.5 + 0.5 * share

    def change(numbers: Any, held: Any, power_w: Any, bits: Any) -> tuple[Any, Any]:
        inside = np.flatnonzero((numbers >= first) & (numbers < end))
        for i in inside if len(bits) else ():
            one.came = True
            there = bits[i, : max(1, int(rows * bits.shape[1]))]
            there |= np.packbits(np.roll(pool, 977 * i)[: there.size * 8]).reshape(there.shape)
        return held, power_w

    yield _light(change)


def _copied(ring: BlockRing, header: BlockHeader, records: Any, bits: Any) -> FrameBlock | None:
    """A block in the next slot of the ring; None if there is none."""
    memory = ring.claim(5.0)
    if memory is None:
        return None
    layout = BlockLayout(len(records), header.width, header.height)
    to_records, to_bits = block_views(memory, layout)
    to_records[:], to_bits[:] = records, bits
    return seal_block(memory, header, layout, payload_crc=True)


def _of(block: FrameBlock) -> Span:
    return block.header.first_frame, block.header.first_frame + block.n_frames


def _block_lost(moment: Moment, one: Struck) -> Patches:
    left = [int(moment.rng.integers(1, 4))]

    def publish(usual: Any, ring: BlockRing, block: FrameBlock) -> None:
        if left[0] and block.header.first_frame >= moment.first:
            left[0] -= 1
            one.came = True
            one.frames.append(_of(block))
            ring.discard()
        else:
            usual(block)

    yield _wrapped(BlockRing, "publish", publish)


def _block_doubled(moment: Moment, one: Struck) -> Patches:
    one.own_end = True

    def publish(usual: Any, ring: BlockRing, block: FrameBlock) -> None:
        kept = block.header, block.records.copy(), block.bits.copy()
        usual(block)
        if not one.came and block.header.first_frame >= moment.first:
            one.came = True
            again = _copied(ring, *kept)
            if again is not None:
                usual(again)

    yield _wrapped(BlockRing, "publish", publish)


def _blocks_swapped(moment: Moment, one: Struck) -> Patches:
    one.own_end = True
    kept: list[Any] = []

    def publish(usual: Any, ring: BlockRing, block: FrameBlock) -> None:
        if not one.came and block.header.first_frame >= moment.first:
            one.came = True
            one.frames.append(_of(block))
            kept.append((block.header, block.records.copy(), block.bits.copy()))
            ring.discard()
            return
        usual(block)
        if kept and (late := _copied(ring, *kept.pop())) is not None:
            usual(late)

    yield _wrapped(BlockRing, "publish", publish)


def _frames_lost(moment: Moment, one: Struck) -> Patches:
    """Single frames, which the device knows of."""
    chance = float(moment.rng.choice([1e-3, 1e-2, 0.1]))
    ahead = SimulatedSpad._frames_ahead

    def frames_ahead(spad: SimulatedSpad) -> tuple[int, bool]:
        n, lost = ahead(spad)
        first = spad._next_frame
        if lost or first < moment.first:
            return n, lost
        one.came = True
        gone = np.random.default_rng([moment.first, first]).random(n) < chance
        change = np.flatnonzero(gone != gone[0])
        n = int(change[0]) if len(change) else n
        if gone[0]:
            one.frames.append((first, first + n))
        return n, bool(gone[0])

    yield patch.object(SimulatedSpad, "_frames_ahead", frames_ahead)


def _ticks(moment: Moment, one: Struck, change: Callable[[int, BlockHeader, Any], tuple[int, Any]]) -> Patches:
    """Changed times of all frames from a block on: `change(t0 of the first one, header, ticks)` gives t0 and ticks."""
    begun: list[int] = []

    def publish(usual: Any, ring: BlockRing, block: FrameBlock) -> None:
        header = block.header
        if header.first_frame >= moment.first:
            if not begun:
                one.came = True
                one.frames.append((header.first_frame, None))
                begun.append(header.t0_ticks)
            t0, ticks = change(begun[0], header, block.records["ticks"].astype(np.int64))
            block.records["ticks"] = ticks
            block = replace(block, header=replace(header, t0_ticks=max(0, t0)))
        usual(block)

    yield _wrapped(BlockRing, "publish", publish)


def _clock_steps(moment: Moment, one: Struck) -> Patches:
    one.own_end = True
    size = 10.0 ** moment.rng.uniform(0, 8) * moment.rng.choice([-1, 1])
    yield from _ticks(moment, one, lambda begun, header, ticks: (header.t0_ticks + int(size), ticks))


def _clock_drifts(moment: Moment, one: Struck) -> Patches:
    one.own_end = True
    rate = 1 + float(10.0 ** moment.rng.uniform(-6, -2) * moment.rng.choice([-1, 1]))

    def drift(begun: int, header: BlockHeader, ticks: Any) -> tuple[int, Any]:
        t0 = begun + round((header.t0_ticks - begun) * rate)
        return t0, np.round(ticks * rate).astype(np.int64)

    yield from _ticks(moment, one, drift)


def _fills(moment: Moment, one: Struck, act: Callable[[Any], bool]) -> Patches:
    """What the SPAD does in place of a block, from a frame on."""

    def fill(usual: Any, spad: SimulatedSpad, ring: BlockRing, timeout_s: float) -> bool:
        if spad._next_frame >= moment.first and (more := act(spad)) is not None:
            one.came = True
            return more
        return bool(usual(ring, timeout_s))

    yield _wrapped(SimulatedSpad, "_do_fill", fill)


def _stalls(moment: Moment, one: Struck) -> Patches:
    """It comes late, and says so in time, or is late without a word."""
    left, word = int(moment.rng.integers(1, 4)), bool(moment.rng.random() < 0.5)
    waits = iter([0.05] * left)

    def act(spad: Any) -> Any:
        wait_s = next(waits, None)
        if wait_s is None:
            return None
        time.sleep(wait_s)
        if word:
            raise DeviceTimeout(f"{spad.name}: no frame came")
        return True

    one.own_end = left > 1  # two silences in a row are taken for the end of it
    yield from _fills(moment, one, act)


def _silent(moment: Moment, one: Struck) -> Patches:
    one.own_end = True

    def act(spad: Any) -> bool:
        one.came = True
        time.sleep(0.05)
        raise DeviceTimeout(f"{spad.name}: no frame came")

    yield from _fills(moment, one, act)


def _unplugged(moment: Moment, one: Struck) -> Patches:
    one.own_end = True

    def act(spad: Any) -> bool:
        one.came = True
        raise DeviceDisconnected(f"{spad.name}: unplugged")

    yield from _fills(moment, one, act)


def _reached(moment: Moment, then: Callable[[], None]) -> Any:
    """A patch that calls `then` once, when the scan has come to the moment."""
    done: list[int] = []

    def publish(usual: Any, ring: BlockRing, block: FrameBlock) -> None:
        usual(block)
        if not done and block.header.first_frame >= moment.first:
            done.append(1)
            then()

    return _wrapped(BlockRing, "publish", publish)


def _scanner_fails(moment: Moment, one: Struck) -> Patches:
    one.own_end = True
    usual = BeamScanner.status

    def fails() -> None:
        one.came = True

    def status(scanner: BeamScanner) -> Any:
        found = usual.fget(scanner)  # type: ignore[attr-defined]
        return replace(found, fault="scanner: its interlock is open") if one.came else found

    yield patch.object(BeamScanner, "status", property(status))
    yield _reached(moment, fails)


def _does_not_stop(moment: Moment, one: Struck) -> Patches:
    """One of the devices cannot be made safe."""
    one.own_end = True
    of, name = [(LineLaser, "pause"), (BeamScanner, "park"), (SyncSource, "abort")][int(moment.rng.integers(3))]

    def fails(usual: Any, device: Any) -> None:
        usual()
        one.came = True
        raise DeviceFault(f"{device.name}: {name} had no answer")

    yield _wrapped(of, name, fails)


def _time_set(moment: Moment, one: Struck) -> Patches:
    """Somebody sets the computer's time of day, by up to ten years."""
    by_ns = int(moment.rng.choice([-1, -1, 1]) * 10.0 ** moment.rng.uniform(6, 17.5))
    clock, clock_ns = time.time, time.time_ns

    def sets() -> None:
        one.came = True

    yield patch.object(time, "time", lambda: clock() + one.came * by_ns / 1e9)
    yield patch.object(time, "time_ns", lambda: clock_ns() + one.came * by_ns)
    yield _reached(moment, sets)


def _disk_slow(moment: Moment, one: Struck) -> Patches:
    longest_s = float(moment.rng.uniform(0.01, 0.1))

    def write(usual: Any, _: Any, block: FrameBlock, *others: Any) -> int:
        if block.header.first_frame >= moment.first:
            one.came = True
            time.sleep(longest_s)
        return int(usual(block, *others))

    yield _wrapped(OpenSegment, "write", write)


def _disk_fails(number: int, moment: Moment, one: Struck) -> Patches:
    one.own_end = True
    of_maps = bool(moment.rng.random() < 0.3)
    map_at = int(moment.rng.integers(0, 3))

    def write(usual: Any, _: Any, block: FrameBlock, *others: Any) -> int:
        if block.header.first_frame >= moment.first:
            one.came = True
            raise OSError(number, os.strerror(number))
        return int(usual(block, *others))

    def write_files(usual: Any, folder: RunFolder, files: Mapping[str, bytes]) -> None:
        if any(name.startswith("stripe/") and int(name[7:13]) >= map_at for name in files):
            one.came = True
            from rig.run_folder.folder import _unwritable

            raise _unwritable(folder.path, OSError(number, os.strerror(number)))
        usual(files)

    yield _wrapped(RunFolder, "_write", write_files) if of_maps else _wrapped(OpenSegment, "write", write)


def _no_memory(moment: Moment, one: Struck) -> Patches:
    """No memory for one of the threads, once."""
    one.own_end = True
    at = int(moment.rng.integers(1, 4))
    of: tuple[Any, str] = [
        (SweepCounter, "add"), (Reconstructor, "map"), (PhotonSource, "_set_rate"), (OpenSegment, "write"),
        (RunFolder, "write_map"),
    ][int(moment.rng.integers(5))]  # fmt: skip
    calls = [0]
    lock = threading.Lock()

    def fails(usual: Any, _: Any, *args: Any, **named: Any) -> Any:
        with lock:
            calls[0] += 1
            if calls[0] == at:
                one.came = True
                raise MemoryError
        return usual(*args, **named)

    yield _wrapped(*of, fails)


def _nothing(moment: Moment, one: Struck) -> Patches:
    """A monitor that raises: see `monitor_of`."""
    return iter(())


FAULTS: Mapping[str, Fault] = {
    "blocks lost": _block_lost,
    "block doubled": _block_doubled,
    "blocks swapped": _blocks_swapped,
    "frames lost": _frames_lost,
    "clock steps": _clock_steps,
    "clock drifts": _clock_drifts,
    "SPAD stalls": _stalls,
    "SPAD silent": _silent,
    "SPAD unplugged": _unplugged,
    "SPAD blinded": _blinded,
    "scanner stands": _mirror_stands,
    "scanner's interlock": _scanner_fails,
    "laser dark": _laser_dark,
    "device not made safe": _does_not_stop,
    "time of day set": _time_set,
    "disk slow": _disk_slow,
    "disk full": partial(_disk_fails, errno.ENOSPC),
    "disk read-only": partial(_disk_fails, errno.EROFS),
    "no memory": _no_memory,
    "monitor killed": _nothing,
}
"""All faults by name."""
SEEN: tuple[str, ...] = ("SPAD blinded", "scanner stands", "laser dark")
"""Faults of light: frames come, at their time, and show something else."""
CLOCKS: tuple[str, ...] = ("clock steps", "clock drifts")
"""Faults that need not be told where they are small: the binding follows a crystal."""
OUT_OF_ORDER: tuple[str, ...] = ("block doubled", "blocks swapped", *CLOCKS)
"""Faults after which blocks come twice, in another order, or with times that do not go on."""
UNKNOWN_LOSS: str = "blocks lost"
"""The fault after which the device's own count of frames does not fit those that came, as `verify` says."""
