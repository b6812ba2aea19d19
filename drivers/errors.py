"""The error tree of everything a device can do wrong: one class per cause, each message one line."""

# ruff: noqa: N818 - a class is named after what happened (`except InterlockOpen:`)


class DeviceError(Exception):
    """Root of the tree. Raised itself only where no subclass fits; `str(error)` is one line for the user."""


class DeviceNotFound(DeviceError):
    """Raised by opening a device that is not attached or does not answer at its address."""


class DeviceBusy(DeviceError):
    """Raised by opening a device that another program holds."""


class DevicePermission(DeviceError):
    """Raised by opening a device that is attached but that this user may not access."""


class DeviceTimeout(DeviceError):
    """Raised when a device or a ring gave nothing within the time the caller allowed."""


class DeviceDisconnected(DeviceError):
    """Raised when a device that was open is gone: unplugged, powered down or its connection closed."""


class DeviceFault(DeviceError):
    """Raised when a device reports a fault of its own or reads back another state than the one it was told."""


class InterlockOpen(DeviceError):
    """Raised when the laser is armed while its interlock is open."""


class LimitExceeded(DeviceError):
    """Raised before anything moves or lights when a request is outside a device's limits; names value and limit."""


class WrongState(DeviceError):
    """Raised by a verb that the device's present state does not allow; names the state and the verb to call first."""


class ProtocolError(DeviceError):
    """Raised when bytes from a device or a file do not follow their protocol."""


class CorruptBlock(ProtocolError):
    """Raised by a block whose magic, checksum, sizes or trailer are wrong: its frames must not be used."""


class UnsupportedBlock(ProtocolError):
    """Raised by a sound block of a sort this reader does not take: other major version, sparse, summed or skipping."""


class GuardLost(DeviceError):
    """Raised by a guarded laser or gate when the guard process that owns their ports is gone; says what was lowered."""


class RingOverflow(DeviceError):
    """Raised when a source had to drop blocks because the ring was full and the overload policy is to abort."""


class UnknownKind(DeviceError):
    """Raised when the registry knows no such kind of device; lists the kinds it knows."""
