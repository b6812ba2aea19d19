"""NI-DAQmx for the scanner `nidaq`: a card of this computer, or one behind NI's gRPC device server.

The package nidaqmx takes the same calls for both. It sets no deadline for a call to a server, so each gets one here.
Its errors become those of `drivers.errors`, in one line with NI's code.

Sources: docs/reference/devices/nidaq.md.
"""

import math
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from fractions import Fraction
from importlib import import_module
from typing import Any, TypeVar

from drivers.errors import (
    CommandRefused,
    DeviceBusy,
    DeviceDisconnected,
    DeviceError,
    DeviceFault,
    DeviceNotFound,
    DeviceTimeout,
    ProtocolError,
)
from drivers.optional_packages import install_command
from drivers.transports.endpoints import one_line

GRPC_PREFIX = "grpc="
CALL_S = 2.0
_LATE_S = 0.5
"""Deadlines for a call to a gRPC server, and for one after a call that was late, as closing takes some 15 calls."""
_CLOSE_S, _CLOSE_LATE_S = 0.5, 0.05
"""The same once the card is being closed."""
_CONNECT_S = 5.0
"""Deadline for reaching a gRPC server."""

_CAUSES: tuple[tuple[type[DeviceError], str, frozenset[int]], ...] = (
    (
        DeviceFault,
        "the points ran dry: lengthen buffer or unload the host",
        frozenset((-200290, -200291, -200621, -200018, -200016)),
    ),
    (
        DeviceDisconnected,
        "check cable and power, then open it again",
        frozenset((-200324, -200045, -201003, -201423, -89130, -88710, -88709, -88705, -50808, -50405)),
    ),
    (DeviceNotFound, "NI MAX shows what there is; correct port, channel and markers", frozenset((-200220, -200170))),
    (
        DeviceBusy,
        "close the program that uses it; if that crashed, restart NI's gRPC server",
        frozenset((-200022, -200587, -50103)),
    ),
    (DeviceTimeout, "check that its clock runs", frozenset((-200474, -200292, -50400))),
)
"""Our errors, each with what to do and NI's codes that mean it. All other codes mean `CommandRefused`."""
_NO_TASK = -200088
"""Code for a task that does not exist: a call that was interrupted has cleared it already."""
_UNSUPPORTED = (-200197, -200452)
"""Codes for a property that a card does not have."""

Value = TypeVar("Value")


def attached_cards() -> list[tuple[str, str]]:
    """Name and model of each card that NI-DAQmx on this computer knows; an empty list without the package nidaqmx or
    NI-DAQmx."""
    try:
        system, errors = import_module("nidaqmx.system"), import_module("nidaqmx.errors")
    except ImportError:
        return []
    try:
        return [(card.name, card.product_type) for card in system.System.local().devices]
    except errors.Error:
        return []


class NiCard:
    """A card: tasks on it, questions to it, and its sample clocks. May be called from any thread. Methods that use
    tasks raise nidaqmx's own errors: call them within `errors`."""

    def __init__(self, address: str) -> None:
        """Load nidaqmx, and connect to the server if the address, "Dev1" or "[grpc=]HOST:PORT/Dev1", names one.

        Raises `ProtocolError` if a package is missing, `DeviceNotFound` if the server does not answer, and the errors
        that `errors` makes of nidaqmx's.
        """
        server, _, self.device = address.removeprefix(GRPC_PREFIX).rpartition("/")
        self.name = f"nidaq {self.device}"
        modules = ("nidaqmx", "nidaqmx.constants", "nidaqmx.stream_writers", "nidaqmx.system", "nidaqmx.errors")
        self._ni, self.const, self.writers, system, errors = map(_import, modules)
        self._error: type[Exception] = errors.Error
        self._tasks: list[Any] = []
        self._call_s, self._late_s = CALL_S, _LATE_S
        self._limit_s = CALL_S
        self._channel = _connect(server, self._deadline_s) if server else None
        self._options = self._ni.GrpcSessionOptions(self._channel, "") if self._channel else None
        try:
            with self.errors():
                self.properties = system.Device(self.device, grpc_options=self._options)
                """The card's properties, a `nidaqmx.system.Device`. Each is asked for when it is read."""
        except BaseException:
            self.disconnect()
            raise

    @contextmanager
    def patient(self, limit_s: float) -> Iterator[None]:
        """Within this context a call to a server may take at most `limit_s`, or the usual time if that is shorter."""
        self._limit_s = min(limit_s, self._call_s)
        try:
            yield
        finally:
            self._limit_s = self._call_s

    def limit_waits(self) -> None:
        """From now on, wait for the server only as long as is allowed while a card is closed."""
        self._call_s, self._late_s = _CLOSE_S, _CLOSE_LATE_S
        self._limit_s = min(self._limit_s, _CLOSE_S)

    def _deadline_s(self, late: bool) -> float:
        """Deadline for a call; late: whether the one before was not answered in time."""
        return min(self._limit_s, self._late_s) if late else self._limit_s

    def disconnect(self) -> None:
        """Close the channel to the server, if there is one. Leaves the card as it is. May raise `DeviceTimeout`."""
        if self._channel is not None:
            _aside(self._channel.close, 1.0)

    @contextmanager
    def errors(self) -> Iterator[None]:
        """Turn nidaqmx's errors within this context into those of `drivers.errors`."""
        try:
            yield
        except self._error as error:
            raise self._ours(error) from error

    def new_task(self) -> Any:
        """A new `nidaqmx.Task`, which lasts until `clear`."""
        self._tasks.append(self._ni.Task(grpc_options=self._options))
        return self._tasks[-1]

    @contextmanager
    def task(self) -> Iterator[Any]:
        """A new `nidaqmx.Task`, which is cleared at the end of the context. That also ends what the task does."""
        task = self.new_task()
        try:
            yield task
        finally:
            self._clear(task)

    def clear(self, keep: int = 0) -> None:
        """Clear all but the `keep` oldest tasks, latest first. If clearing some of them failed, raises the last error
        afterwards. An interrupt (Ctrl-C) leaves the remaining tasks as they are."""
        failed: Exception | None = None
        while len(self._tasks) > keep:
            try:
                self._clear(self._tasks[-1])
            except self._error as error:
                failed = error
        if failed is not None:
            raise failed

    def _clear(self, task: Any) -> None:
        try:
            if task._handle is not None:  # else an interrupt came right after it was closed
                task.close()
        except self._ni.DaqError as error:
            if error.error_code != _NO_TASK:
                raise
        finally:
            if task._handle is None and task in self._tasks:  # else it was interrupted, or another thread was faster
                self._tasks.remove(task)

    def terminal(self, name: str) -> str:
        """The full name of a terminal. A name without a device means a terminal of this card."""
        return name if name.startswith("/") else f"/{self.device}/{name}"

    def property_of(self, ask: Callable[[], Value]) -> Value | None:
        """The answer of `ask`, which reads a property; None if this card does not have that property."""
        try:
            return ask()
        except self._ni.DaqError as error:
            if error.error_code in _UNSUPPORTED:
                return None
            raise

    def nearest_clock(self, task: Any, wanted_hz: float, low_hz: float, high_hz: float) -> Fraction:
        """Set a task's sample clock to the rate nearest to `wanted_hz` that its divider makes within the limits, and
        return that rate. A card that does not state its timebase is set to `wanted_hz`, whatever the limits are."""
        clock_hz = self.tune(task, Fraction(wanted_hz))
        base_hz = self._timebase(task)
        if base_hz is None:
            return clock_hz
        divisor = max(round(base_hz / Fraction(wanted_hz)), math.ceil(base_hz / Fraction(high_hz)))
        return self.tune(task, base_hz / min(divisor, math.floor(base_hz / Fraction(low_hz))))

    def tune(self, task: Any, rate_hz: Fraction, source: str = "", samples: int = 1000) -> Fraction:
        """Set up a task to run until it is stopped, with this sample clock. Returns the exact rate.

        source: terminal of a clock at this rate; "" is the card's own clock, whose rate is read back. samples: size of
        the buffer.
        """
        timing, continuous = task.timing, self.const.AcquisitionType.CONTINUOUS
        timing.cfg_samp_clk_timing(float(rate_hz), source=source, sample_mode=continuous, samps_per_chan=samples)
        if source:
            return rate_hz
        base_hz = self._timebase(task)
        return Fraction(timing.samp_clk_rate) if base_hz is None else base_hz / int(timing.samp_clk_timebase_div)

    def _timebase(self, task: Any) -> Fraction | None:
        """Rate of the timebase that is divided; None: this card does not say."""
        return self.property_of(lambda: Fraction(task.timing.samp_clk_timebase_rate))

    def _ours(self, error: Exception) -> DeviceError:
        text = one_line(Exception(str(error).partition("\n\n")[0])).rstrip(".")
        code = getattr(error, "error_code", None)
        if code is not None:
            for kind, advice, codes in _CAUSES:
                if code in codes:
                    return kind(f"{self.name}: NI error {code}: {text}; {advice}")
            return CommandRefused(f"{self.name}: NI error {code}: {text}; correct the config")
        status = getattr(getattr(error, "rpc_code", None), "name", None)
        if status is None:
            return DeviceNotFound(f"{self.name}: {text}; install NI-DAQmx on this computer, or use a gRPC server")
        if status in ("UNAVAILABLE", "CANCELLED"):
            return DeviceDisconnected(f"{self.name}: gRPC server lost, while the card keeps its levels; check both")
        if status == "DEADLINE_EXCEEDED":
            return DeviceTimeout(f"{self.name}: no answer of the gRPC server in time; check the network")
        return ProtocolError(f"{self.name}: gRPC {status}: {text}; check NI's gRPC device server")


def _import(module: str) -> Any:
    try:
        return import_module(module)
    except ImportError as error:
        command = install_command("nidaqmx")
        raise ProtocolError(f"nidaq: no package {error.name}; install the extra spadrig[nidaq]: {command}") from error


def _connect(server: str, deadline_s: Callable[[bool], float]) -> Any:
    grpc = _import("grpc")

    class Deadline(grpc.UnaryUnaryClientInterceptor):  # type: ignore[misc, name-defined]
        late = False

        def intercept_unary_unary(self, go_on: Any, details: Any, request: Any) -> Any:
            limited = details._replace(timeout=deadline_s(self.late))
            call = _aside(lambda: go_on(limited, request), CALL_S + 1)
            self.late = call.code() is grpc.StatusCode.DEADLINE_EXCEEDED
            return call

    def connect() -> Any:
        channel = grpc.insecure_channel(server, options=[("grpc.enable_http_proxy", 0)])
        try:
            grpc.channel_ready_future(channel).result(timeout=_CONNECT_S)
        except grpc.FutureTimeoutError:
            channel.close()
            return None
        return grpc.intercept_channel(channel, Deadline())

    if (channel := _aside(connect, _CONNECT_S + 1)) is None:
        raise DeviceNotFound(f"nidaq: no answer at {server}; start NI's gRPC device server there, or correct port")
    return channel


def _aside(work: Callable[[], Value], limit_s: float) -> Value:
    """Do work in a thread of its own; returns or raises what it does. Ctrl-C ends the wait for it, never the work: an
    interrupt inside gRPC can leave gRPC's locks closed for good. Raises `DeviceTimeout` after the limit."""
    answer: Future[Value] = Future()

    def act() -> None:
        try:
            answer.set_result(work())
        except BaseException as error:
            answer.set_exception(error)

    try:
        threading.Thread(target=act, daemon=True).start()
    except RuntimeError:  # Python is ending: since 3.12 no thread begins then
        act()
    try:
        return answer.result(limit_s)
    except TimeoutError:
        raise DeviceTimeout(f"nidaq: gRPC hangs for {limit_s:g} s; start the program anew") from None
