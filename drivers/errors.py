"""The errors that devices raise: one class per cause, with a message of one line."""

# ruff: noqa: N818 - a class is named after what happened (`except InterlockOpen:`)


class DeviceError(Exception):
    """Base class of all device errors. Raised itself only if no subclass fits; `str(error)` is one line for the
    user."""


class DeviceNotFound(DeviceError):
    """Raised when a device to be opened is not attached or does not answer as its kind does, when its address cannot be
    used, or when a recording cannot be found or read.
    """


class NoAnswer(DeviceNotFound):
    """Raised when a port is there, but nothing on it answers as the kind to be opened does."""


class DeviceBusy(DeviceError):
    """Raised when a device to be opened is held by another program."""


class DevicePermission(DeviceError):
    """Raised when a device to be opened is attached but this user may not access it."""


class DeviceTimeout(DeviceError):
    """Raised when a device does not answer, or the block ring has no free slot or no new block, in the time allowed."""


class DeviceDisconnected(DeviceError):
    """Raised when a device that was open is gone: unplugged, powered down or its connection closed."""


GONE = (DeviceDisconnected, DeviceTimeout)
"""For an `except`: a device that was open is gone or does not answer, so that nothing can be done to it from here."""


class DeviceFault(DeviceError):
    """Raised when a device reports a fault of its own, or does not do what it was told."""


class EmergencyStop(DeviceFault):
    """Raised when a device stays in emergency stop: somebody holds its stop input."""


class InterlockOpen(DeviceError):
    """Raised when a laser's interlock is open while the laser is armed or about to be armed."""


class LimitExceeded(DeviceError):
    """Raised when a request is outside a device's limits, or malformed, before anything moves or lights."""


class WrongState(DeviceError):
    """Raised when the device's state does not allow the method that is called, or another thread has interrupted that
    method (as `pause` interrupts `arm`).
    """


class ProtocolError(DeviceError):
    """Raised when bytes from a device or a file do not follow their protocol, or when the Python package that reads
    them is not installed."""


class CommandRefused(ProtocolError):
    """Raised when the device does not know a command, or refuses it in its present state."""


class CorruptBlock(ProtocolError):
    """Raised when a block or an index is damaged, or is not the one that is expected. It must not be used."""


class UnsupportedBlock(ProtocolError):
    """Raised when a block is of a kind that `drivers.spb1` does not read as frames: another major version, several bits
    per pixel, sparse, summed frames, only every k-th frame, or a control block."""


class GuardLost(DeviceError):
    """Raised when the guard process that owns the ports of laser and gate is gone. The message says which devices were
    made safe, if that is known by then."""


class RingOverflow(DeviceError):
    """Raised when a source had to drop a block because the block ring was full, and the overload policy is to abort."""


class UnknownKind(DeviceError):
    """Raised when the registry has no usable device kind of the name that was asked for. The message lists the kinds
    there are, or says why this one cannot be used."""
