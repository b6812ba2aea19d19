"""Devices in memory that note what they are told, a SPAD that plays streams, and a maker of maps that takes no time."""

import dataclasses
import itertools
import threading
import time
from fractions import Fraction

import numpy as np

from drivers.clock import VirtualClock
from drivers.errors import DeviceTimeout
from drivers.frames import BlockFlag
from drivers.interfaces import LaserLimits, LaserStatus, ScannerStatus, SpadCounters, SpadTiming
from rig.count.volume import SweepCounter
from rig.depth.reconstruct import FogEstimate, MapResult
from rig.devices.open import OpenRig
from rig.geometry.stripe_table import StripeTable
from rig.scan.acquisition import Acquisition, AcquisitionRequest
from rig.scan.monitor import Listeners
from rig.threads import RowWorkers
from tests.unit.rig.count.streams import SPAD, scan

STOP = ["sync.abort", "laser.pause", "scanner.park", "spad.stop"]
START = ["scanner.load", "sync.program", "sync.gate_low", "laser.arm", "spad.start", "sync.run", "scanner.start"]
STRIDE = 4096
PATIENCE_S = 20.0
"""A test that waits so long for something has failed."""


class Device:
    """A device that notes the verbs it is told, in one list shared by all, and fails where it is asked to."""

    def __init__(self, name, log, failing=()):
        self.name, self.log, self.failing = name, log, dict(failing)

    def told(self, verb):
        self.log.append(f"{self.name}.{verb}")
        if verb in self.failing:
            raise self.failing[verb]

    def __getattr__(self, verb):
        """Any verb that is only noted."""
        return lambda *_: self.told(verb)


class FakeScanner(Device):
    fault = None

    def load(self, waveform, repeats):
        self.told("load")
        self.repeats = repeats
        return waveform.point_rate_hz

    @property
    def status(self):
        return ScannerStatus(True, self.fault, None)


class FakeLaser(Device):
    gate_only = False
    limits = LaserLimits(0.0, 0.05)

    def arm(self, power_w):
        self.told("arm")
        self.power_w = power_w
        self.cold = 3

    @property
    def status(self):
        self.cold -= 1
        return LaserStatus(self.cold <= 0, True, True, None, None, self.cold > 0, "digital")


class FakeSync(Device):
    most = None

    def most_repeats(self, pulses):
        return self.most


class FakeSpad(Device):
    """Plays streams, one per start, as `SpadArray.fill` is to; `behaviour` is called with the number of every block.

    One that cannot wait does not either where the ring would let it.
    """

    def __init__(self, log, streams, failing=(), size=16, lost=(), behaviour=lambda seq: None, can_wait=True):
        super().__init__("spad", log, failing)
        self.info = dataclasses.replace(SPAD, can_wait=can_wait)
        self.streams = iter(streams)
        self.size, self.lost, self.behaviour = size, lost, behaviour
        self.stopped = threading.Event()
        self.delivered, self.dropped = [], []
        self.counters = SpadCounters(0, 0, 0, 0, 0)

    def start(self, n_frames):
        self.told("start")
        self.n_frames = n_frames
        self.stopped.clear()
        self.counters = SpadCounters(0, 0, 0, 0, 0)
        self.blocks = iter(next(self.streams).blocks(itertools.repeat(self.size), self.lost))
        self.pending = None
        self.seq, self.flags = 0, BlockFlag(0)

    def fill(self, ring, timeout_s):
        self.ring = ring
        if self.stopped.is_set():
            return False
        block, self.pending = self.pending or next(self.blocks, None), None
        if block is None:
            return False
        self.behaviour(block.header.block_seq)
        if ring.claim(timeout_s if self.info.can_wait else 0) is None:
            if ring.waits and self.info.can_wait:
                self.pending = block
                raise DeviceTimeout("spad: no free slot")
            self._drop(ring, block)
            return True
        exposed, delivered, lost, *_ = dataclasses.astuple(self.counters)
        header = dataclasses.replace(
            block.header, block_seq=self.seq, lost_before=block.header.lost_before + lost, flags=self.flags
        )
        self.counters = SpadCounters(exposed + block.n_frames, delivered + block.n_frames, lost, 0, 0)
        self.delivered += block.frame_numbers.tolist()
        self.seq, self.flags = self.seq + 1, BlockFlag(0)
        ring.publish(dataclasses.replace(block, header=header))
        return True

    def _drop(self, ring, block):
        exposed, delivered, lost, *_ = dataclasses.astuple(self.counters)
        self.counters = SpadCounters(exposed + block.n_frames, delivered, lost + block.n_frames, 0, 0)
        self.dropped += block.frame_numbers.tolist()
        self.flags = BlockFlag.LOST_BEFORE
        ring.mark_overflow(block.n_frames)

    def stop(self):
        self.told("stop")
        self.stopped.set()


class FakeMaker:
    """Makes maps of nothing, remembers the counts and does `before(index)` first, on the counting thread."""

    def __init__(self, before=lambda index: None):
        self.before = before
        self.volumes = []

    def counter(self, layout):
        return SweepCounter(layout, RowWorkers(1))

    def map(self, volume):
        self.before(len(self.volumes))
        self.volumes.append(volume)
        empty = np.zeros((1, 1), np.float32)
        depth = empty, empty, empty
        fog = FogEstimate(None, None, None)
        return MapResult(StripeTable.empty(1, 1), *depth, empty.astype(np.uint32), fog, 1e-3, None)


def fake_rig(plan, streams, failing=None, power=None, **spad):
    """A rig of fakes and the list of what they are told."""
    failing = failing or {}
    log: list[str] = []
    config = dataclasses.make_dataclass("Config", ["scan", "spad"])(scan(power=power), spad=None)
    makes = {"scanner": FakeScanner, "laser": FakeLaser, "sync": FakeSync}
    devices = {name: make(name, log, failing.get(name, {})) for name, make in makes.items()}
    fake = FakeSpad(log, streams, failing.get("spad", {}), **spad)
    return OpenRig(config=config, clock=VirtualClock(), world=None, spad=fake, model=None, **devices), log


def acquisition(rig, plan, maps, maker=None, **options):
    """An acquisition with the fakes, and little patience with silence."""
    period = int(100_000_000 / plan.frame_rate_hz)
    timing = SpadTiming(Fraction(100_000_000), period, period, STRIDE)
    listeners = Listeners(**{name: options.pop(name) for name in ("live", "monitor", "watched") if name in options})
    request = AcquisitionRequest(maps=maps, listeners=listeners, **{"silence_s": 0.2, **options})
    return Acquisition(rig, plan, timing, maker or FakeMaker(), request)


def wait_until(condition):
    """Wait for something that another thread brings about."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < PATIENCE_S, "it never came about"
        time.sleep(0.001)


def pipeline_threads():
    """Names of the threads of pipelines that are alive."""
    names = {"spad source", "counting", "recorder", "monitor"}
    return [thread.name for thread in threading.enumerate() if thread.name in names]
