"""The udev rules name every USB device that a driver opens."""

import re
from pathlib import Path

from drivers.transports.endpoints import UDEV_RULES

ROOT = Path(__file__).parents[3]
IDS = sorted(
    {
        (f"{int(vendor, 16):04x}", f"{int(product, 16):04x}")
        for file in (ROOT / "drivers").rglob("*.py")
        for vendor, product in re.findall(r"UsbId\([^,()]+, 0x(\w{4}), 0x(\w{4})", file.read_text(encoding="utf-8"))
    }
)


def test_a_rule_names_each_device_and_its_head_says_how_to_install_it() -> None:
    rules = (ROOT / UDEV_RULES).read_text(encoding="utf-8")
    assert ("1209", "e500") in IDS
    for vendor, product in IDS:
        assert f'ATTR{{idVendor}}=="{vendor}", ATTR{{idProduct}}=="{product}"' in rules
    assert any(line.startswith("#") and "/etc/udev/rules.d/" in line for line in rules.splitlines()[:3])
