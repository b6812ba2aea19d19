"""The SPB1 driver over real libusb, in a process of its own under umockdev, with both chips."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from drivers.clock import SystemClock
from drivers.spb1.control import Register, SensorState
from sim_backend.wire.firmware.spb_usb import SpbUsbModel
from sim_backend.wire.serve.usb_model import AttachedDevice
from tests.wire.bodies import outcomes
from tests.wire.spads import spb_bodies
from tests.wire.spb_device import model
from tests.wire.usb.umockdev import UmockdevBus, missing


@contextmanager
def pulling(attached: AttachedDevice, device: SpbUsbModel) -> Iterator[None]:
    """Pull the cable a moment after a run with the agreed heartbeat begins."""
    over = threading.Event()

    def watch() -> None:
        while not over.wait(0.02):
            if device.state is SensorState.RUNNING and device._registers[Register.HEARTBEAT_MS] == 12_345:
                over.wait(0.1)
                attached.unplug()
                return

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@pytest.fixture(scope="module", params=["fx3", "ft601"])
def over_libusb(request: pytest.FixtureRequest) -> dict[str, str]:
    """What became of each body in a process of its own, with real libusb."""
    if missing():
        pytest.skip(missing())
    device = model(chip=request.param)
    with UmockdevBus(SystemClock()) as bus, pulling(bus.plug(device), device):
        return outcomes(bus, "tests.wire.spads.spb_bodies", request.param)


@pytest.mark.parametrize("body", spb_bodies.BODIES, ids=lambda body: body.__name__)
def test_over_libusb(body: Callable[[], None], over_libusb: dict[str, str]) -> None:
    assert over_libusb[body.__name__] == ""
