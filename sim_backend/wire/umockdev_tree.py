"""The part of /sys and /dev that libusb and libudev read of an emulated USB device, as files for umockdev."""

from pathlib import Path

from sim_backend.wire.usb_descriptors import SPEED_MBIT
from sim_backend.wire.usb_model import AttachedDevice

_USB_MAJOR = 189


def write_tree(device: AttachedDevice, root: Path) -> Path:
    """What libusb and libudev read of a device; returns the file with the present configuration."""
    name = f"{device.bus}-{device.port}"
    folder = root / f"sys/devices/usb{device.bus}/{name}"
    folder.mkdir(parents=True)
    node = f"bus/usb/{device.bus:03}/{device.address:03}"
    minor = device.address - 1 + 128 * (device.bus - 1)
    spec = device.spec
    texts = {
        "uevent": (
            f"MAJOR={_USB_MAJOR}\nMINOR={minor}\nDEVNAME={node}\nDEVTYPE=usb_device\nDRIVER=usb\n"
            f"PRODUCT={spec.vendor:x}/{spec.product:x}/{spec.release:x}\nTYPE=0/0/0\n"
            f"BUSNUM={device.bus:03}\nDEVNUM={device.address:03}\n"
        ),
        "busnum": f"{device.bus}\n",
        "devnum": f"{device.address}\n",
        "speed": f"{SPEED_MBIT[spec.speed]}\n",
        "bConfigurationValue": f"{device.configuration}\n",
    }
    for file, text in texts.items():
        (folder / file).write_text(text)
    (folder / "descriptors").write_bytes(spec.device_descriptor() + spec.configuration_descriptor())
    (folder / "subsystem").symlink_to("../../../bus/usb")
    (root / "sys/bus/usb/devices" / name).symlink_to(f"../../../devices/usb{device.bus}/{name}")
    (root / "dev/.node" / node.replace("/", "_")).symlink_to(f"{_USB_MAJOR}:{minor}")
    return folder / "bConfigurationValue"
