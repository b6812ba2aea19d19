"""The last work on a device that nobody closed. It is done when the device is deleted or Python ends."""

import threading
import weakref
from collections.abc import Callable


def watch_for_end(device: object, end: Callable[[], object]) -> "weakref.finalize[..., object]":
    """Have `end` called when the device is deleted or Python ends, unless the finalizer that is returned is detached.

    end: must not refer to the device. If the device is deleted on another thread than the main one, `end` is called on
    a new thread: the thread that deletes the device may be in the middle of talking to it, or may be a daemon, which
    stops when Python ends. If a `KeyboardInterrupt` breaks it off, it is called once more.
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
