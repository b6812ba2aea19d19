"""The last work on a device that nobody closed: when it is deleted, or Python ends."""

import threading
import weakref
from collections.abc import Callable


def watch_for_end(device: object, end: Callable[[], object]) -> "weakref.finalize[..., object]":
    """Have `end` called when the device is deleted or Python ends, unless the finalizer that is returned is detached.

    end: must not refer to the device. It is called on the main thread, or on a thread of its own: one that deletes the
    device may be in the middle of talking to it, or a daemon, which stops when Python ends.
    """
    return weakref.finalize(device, _call, end)


def _call(end: Callable[[], object]) -> None:
    if threading.current_thread() is not threading.main_thread():
        try:
            threading.Thread(target=end, name="end of a device", daemon=False).start()
        except RuntimeError:  # Python is ending already
            end()
        return
    try:
        end()
    except KeyboardInterrupt:  # impatient people, or `timeout`: the device must be safe all the same
        end()
        raise
