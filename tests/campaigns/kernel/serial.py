"""The serial drivers through a real kernel's own USB serial driver: boots Debian's kernel in QEMU and runs tests in it.

python -m tests.campaigns.kernel.serial --kernel FOLDER

FOLDER holds kernel and drivers, fetched the first time (qemu_kernel.sh; QEMU and three tools by apt).
Every emulated serial device of the tests is then behind an FTDI chip that QEMU emulates, on an xHCI controller:
pyserial -> tty -> ftdi_sio -> USB -> QEMU's chip -> a virtio port -> the emulator, which is in the guest as well.
Cables are pulled by QEMU. Without virtualisation by the processor it is slow. Passes where all tests do.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.campaigns.kernel import guest
from tests.wire.kernel_serial_ports import QMP, WIRES

FETCH = Path(__file__).with_name("qemu_kernel.sh")
TESTS = (
    "tests/conformance/test_line_laser.py",
    "tests/conformance/test_sync_source.py",
    "tests/wire/test_serial_port.py",
    "tests/wire/test_serial_lasers.py",
    "tests/wire/test_obis.py",
    "tests/wire/test_cobolt.py",
    "tests/wire/test_prawndo.py",
)
LEFT_OUT = "not simulated and not replay and not takes_nothing"
"""Devices that are not on a wire; and a device that takes nothing: an adapter takes all in its place."""
WITHIN_S = 3600.0


def main() -> int:
    """1 where a test failed, 2 where there is no kernel."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kernel", type=Path, default=Path.home() / ".cache" / "spadrig-qemu")
    parser.add_argument("--tests", nargs="*", default=TESTS)
    options = parser.parse_args()
    if subprocess.run(["sh", FETCH, options.kernel], check=False).returncode:
        return 2
    plugin = ["-m", guest.__name__, "-p", "tests.wire.kernel_serial_ports", "-k", f'"{LEFT_OUT}"']
    arguments = [*plugin, *options.tests, guest.END]
    with tempfile.TemporaryDirectory(prefix="spadrig-qemu-") as sockets:
        return int(not guest.passed(machine(options.kernel, sockets, arguments), WITHIN_S))


def machine(kernel: Path, sockets: str, arguments: list[str]) -> list[str | Path]:
    """The command that runs Python with these arguments as the guest's first process."""
    environment = [f"PYTHONPATH={guest.ROOT}", "PYTHONDONTWRITEBYTECODE=1"]
    command_line = ["console=ttyS0", "quiet", "panic=-1", *environment, "--", sys.executable, *arguments]
    return [
        "qemu-system-x86_64", "-nodefaults", "-no-reboot", "-display", "none", "-serial", "stdio",
        "-machine", "q35", "-cpu", "max", "-m", "1500M",
        "-kernel", kernel / "vmlinuz", "-initrd", kernel / "initramfs", "-append", " ".join(command_line),
        "-fsdev", "local,id=host,path=/,security_model=none,readonly=on,multidevs=remap",
        "-device", "virtio-9p-pci,fsdev=host,mount_tag=host",
        "-device", "qemu-xhci,id=xhci", "-device", "virtio-serial-pci",
        *[part for name in WIRES for part in _wire(name, f"{sockets}/{name}")],
        *_wire(QMP, f"{sockets}/{QMP}"), "-mon", f"chardev={QMP},mode=control",
    ]  # fmt: skip


def _wire(name: str, socket: str) -> list[str]:
    """A chardev for QEMU, the other end of which is a port of that name in the guest."""
    ours, theirs = f"socket,id={name},path={socket},server=on,wait=off", f"socket,id={name}-end,path={socket}"
    return ["-chardev", ours, "-chardev", theirs, "-device", f"virtserialport,chardev={name}-end,name={name}"]


if __name__ == "__main__":
    sys.exit(main())
