"""The drivers through a real kernel's USB stack: the bodies that umockdev runs, and what only a kernel does.

Needs root and a kernel with vhci-hcd; `python -m tests.campaigns.kernel.usb` boots one that has it.
"""

from collections.abc import Callable, Iterator

import pytest

from drivers.clock import SystemClock
from tests.wire import helios_over_libusb, spb_bodies, usb_bodies
from tests.wire.bodies import ServesProcesses, outcomes
from tests.wire.spb_device import model
from tests.wire.test_spb_over_libusb import pulling
from tests.wire.usb.loopback import LoopbackModel
from tests.wire.usb.usbip import UsbIpBus, missing

if missing():
    pytest.skip(missing(), allow_module_level=True)


@pytest.fixture
def bus() -> Iterator[UsbIpBus]:
    with UsbIpBus(SystemClock()) as made:
        yield made


@pytest.fixture(scope="module")
def loopback() -> dict[str, str]:
    with UsbIpBus(SystemClock()) as bus:
        bus.plug(LoopbackModel())
        return outcomes(bus, "tests.wire.usb_bodies")


@pytest.fixture(scope="module", params=["fx3", "ft601"])
def spad(request: pytest.FixtureRequest) -> dict[str, str]:
    device = model(chip=request.param)
    with UsbIpBus(SystemClock()) as bus, pulling(bus.plug(device), device):
        return outcomes(bus, "tests.wire.spb_bodies", request.param)


@pytest.mark.parametrize("body", [body.__name__ for body in usb_bodies.BODIES])
def test_the_transport(body: str, loopback: dict[str, str]) -> None:
    assert loopback[body] == ""


@pytest.mark.parametrize("body", [body.__name__ for body in spb_bodies.BODIES])
def test_the_spad(body: str, spad: dict[str, str]) -> None:
    assert spad[body] == ""


@pytest.mark.parametrize("body", helios_over_libusb.BODIES, ids=lambda body: body.__name__)
def test_the_scanner(body: Callable[[ServesProcesses], None], bus: UsbIpBus) -> None:
    body(bus)
