"""How fast the SPB1 driver takes a stream, against a bare libusb loop on the same emulated device; and who wins.

    python -m tests.benchmarks.spb_usb

The device is emulated under real libusb (umockdev) in this process and sends blocks of 31 full frames, 1 MiB each, as
fast as they are taken. Clients are processes of their own: a bare loop that keeps eight reads of 1 MiB in flight with
usb1 and looks at nothing, into eight buffers over and over; the driver with the same reads queued; and the driver with
plain reads one after the other (pyusb). They take turns. CPU share: the
client's processor time over wall time, all threads. The driver checks headers and trailers, publishes every block to a
reader and pings; at this rate it leaves payload CRCs to the recorder. Blocks dropped for want of a slot do not count.
"""

import argparse
import ctypes
import json
import statistics
import subprocess
import sys
import threading
import time
from fractions import Fraction
from typing import Any

import numpy as np

from drivers.clock import SystemClock
from drivers.interfaces import SpadRequest
from drivers.ring import BlockRing
from drivers.spads.spb_usb import SpbUsb, SpbUsbConfig, open_link
from drivers.spb1.control import Op, Register
from drivers.transports.bulk_link import QueuedLink
from drivers.transports.endpoints import Endpoint
from sim_backend.wire.firmware.spb_usb import SpbUsbModel
from sim_backend.wire.firmware.spb_usb_run import SpbUsbBoard
from tests.wire.spb_device import TiledSource
from tests.wire.usb.umockdev import UmockdevBus, missing

STRIDE = 1 << 20
FRAMES = 31
IN_FLIGHT = 8
SLOTS = 16
_PR_SET_TIMERSLACK = 29
CLIENTS = {
    "raw": "bare usb1 loop, 8 buffers",
    "queued": "driver, queued reads (usb1)",
    "plain": "driver, plain reads (pyusb)",
}


def client(sort: str, seconds: float) -> dict[str, float]:
    """Take the stream for a while; MB/s and CPU share."""
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    config = SpbUsbConfig(reads="plain" if sort == "plain" else "queued", test_pattern=False)
    link = open_link(config, Endpoint("usb"))
    with SpbUsb(config, link, SystemClock()) as device:
        timing = device.configure(SpadRequest(Fraction(100_000), 1e-5, "stream", FRAMES))
        assert timing.stride <= STRIDE
        if sort == "raw":
            assert isinstance(link, QueuedLink)
            return _raw(device, link, timing.stride, seconds)
        return _driver(device, timing.stride, seconds)


def _raw(device: SpbUsb, link: QueuedLink, stride: int, seconds: float) -> dict[str, float]:
    """usb1 and nothing else, into touched memory."""
    device._control.write_all(((Register.HEARTBEAT_MS, 0), (Register.N_FRAMES, 0), (Register.N_FRAMES + 4, 0)))
    device._control.send(Op.START)
    taken, going = 0, True

    def again(transfer: Any) -> None:
        nonlocal taken
        taken += transfer.getActualLength()
        if going:
            transfer.submit()

    transfers = []
    for memory in np.zeros((IN_FLIGHT, stride), np.uint8):
        transfer = link._handle.getTransfer()
        transfer.setBulk(0x81, memory.data, callback=again, timeout=0)
        transfer.submit()
        transfers.append(transfer)
    begun, cpu, base = time.perf_counter(), time.process_time(), taken
    while time.perf_counter() - begun < seconds:
        link._context.handleEventsTimeout(0.05)
    result = _result(taken - base, begun, cpu)
    going = False
    while any(transfer.isSubmitted() for transfer in transfers):
        link._context.handleEventsTimeout(0.05)
    for transfer in transfers:
        transfer.close()
    device._control.send(Op.ABORT)
    return result


def _driver(device: SpbUsb, stride: int, seconds: float) -> dict[str, float]:
    ring = BlockRing(SLOTS, stride)
    reader = ring.reader("benchmark")
    thread = threading.Thread(target=lambda: [None for _ in reader], daemon=True)
    thread.start()
    device.start(None)
    for _ in range(IN_FLIGHT):
        device.fill(ring, 2.0)
    begun, cpu, before = time.perf_counter(), time.process_time(), device.counters.delivered
    while time.perf_counter() - begun < seconds:
        device.fill(ring, 2.0)
    result = _result((device.counters.delivered - before) // FRAMES * stride, begun, cpu)
    assert device.counters.crc_errors == 0
    result["lost_share"] = (device.counters.lost or 0) / (device.counters.exposed or 1)
    device.stop()
    ring.finish()
    thread.join()
    return result


def _result(taken: int, begun: float, cpu: float) -> dict[str, float]:
    wall_s = time.perf_counter() - begun
    return {"mb_per_s": taken / wall_s / 1e6, "cpu_share": (time.process_time() - cpu) / wall_s, "lost_share": 0.0}


def measure(rounds: int, seconds: float) -> dict[str, dict[str, float]]:
    """Medians over the rounds, by client."""
    results: dict[str, list[dict[str, float]]] = {sort: [] for sort in CLIENTS}
    device = SpbUsbModel(TiledSource(), SpbUsbBoard(512, 512, payload_crc=False, link_bytes_per_s=4_000_000_000))
    with UmockdevBus(SystemClock()) as bus:
        bus.plug(device)
        for _ in range(rounds):
            for sort in CLIENTS:
                words = "-m", "tests.benchmarks.spb_usb", "--client", sort, "--seconds", str(seconds)
                command = [sys.executable, *words]
                done = subprocess.run(command, env=bus.environment(), stdout=subprocess.PIPE, text=True, check=True)
                results[sort].append(json.loads(done.stdout))
    return {
        sort: {key: statistics.median(one[key] for one in found) for key in found[0]} for sort, found in results.items()
    }


def main() -> int:
    """Measure, print, and fail where the driver reaches less than 0.8 of the bare loop."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--client", choices=CLIENTS)
    asked = parser.parse_args()
    if asked.client is not None:
        print(json.dumps(client(asked.client, asked.seconds)))
        return 0
    if missing():
        print(missing())
        return 0
    medians = measure(asked.rounds, asked.seconds)
    raw = medians["raw"]["mb_per_s"]
    for sort, found in medians.items():
        ratio = found["mb_per_s"] / raw
        print(
            f"{CLIENTS[sort]:<28} {found['mb_per_s']:7.0f} MB/s  {ratio:5.2f}  CPU {found['cpu_share']:4.0%}"
            + (f", lost {found['lost_share']:.1%}: the reader had no processor" if found["lost_share"] else "")
        )
    return 0 if medians["queued"]["mb_per_s"] >= 0.8 * raw else 1


if __name__ == "__main__":
    sys.exit(main())
