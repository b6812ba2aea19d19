"""The errors that devices raise: one class per cause, with a message of one line."""

# ruff: noqa: N818 - a class is named after what happened (`except InterlockOpen:`)


class DeviceError(Exception):
    """Base class of all device errors. Raised itself only if no subclass fits; `str(error)` is one line for the
    user."""


class DeviceNotFound(DeviceError):
    """Raised when a device to be opened is not attached or does not answer at its address."""


class DeviceBusy(DeviceError):
    """Raised when a device to be opened is held by another program."""


class DevicePermission(DeviceError):
    """Raised when a device to be opened is attached but this user may not access it."""


class DeviceTimeout(DeviceError):
    """Raised when a device or a ring gave nothing within the time the caller allowed."""


class DeviceDisconnected(DeviceError):
    """Raised when a device that was open is gone: unplugged, powered down or its connection closed."""


class DeviceFault(DeviceError):
    """Raised when a device reports a fault of its own, or reads back a state other than the one it was set to."""


class InterlockOpen(DeviceError):
    """Raised when the laser is armed while its interlock is open."""


class LimitExceeded(DeviceError):
    """Raised when a request is outside a device's limits, before anything moves or lights. Names the value and the
    limit.
    """


class WrongState(DeviceError):
    """Raised when a method is called that the device's present state does not allow. Names the state and the method to
    call first.
    """


class ProtocolError(DeviceError):
    """Raised when bytes from a device or a file do not follow their protocol."""


class CorruptBlock(ProtocolError):
    """Raised when the magic, checksum, sizes or trailer of a block are wrong. Its frames must not be used."""


class UnsupportedBlock(ProtocolError):
    """Raised when a sound block is of a kind this reader does not take: another major version, sparse, summed or
    skipping.
    """


class GuardLost(DeviceError):
    """Raised by a guarded laser or gate when the guard process that owns its port is gone. Says which devices were made
    safe.
    """


class RingOverflow(DeviceError):
    """Raised when a source had to drop blocks because the ring was full and the overload policy is to abort."""


class UnknownKind(DeviceError):
    """Raised when the registry has no kind of that name. Lists the kinds it has."""
