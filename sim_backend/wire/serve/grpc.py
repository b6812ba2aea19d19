"""Serves a model of an NI card as NI's gRPC device server does (github.com/ni/grpc-device), on this computer.

The package `nidaqmx` itself connects to it. The messages come with that package, and so does grpc.
"""

import re
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

import numpy as np

from drivers.clock import Clock
from drivers.errors import DeviceError
from drivers.optional_packages import install_command
from sim_backend.wire.firmware.nidaq import Call
from sim_backend.wire.firmware.nidaq_parts.daq_task import DaqmxError
from sim_backend.wire.serve.tcp import HOST
from sim_backend.wire.serve.wire_server import WireServer

WORKERS = 8
"""Calls served at a time. A call that waits occupies one."""
_POLL_S = 0.001
"""Time, of the model's clock, after which a call that waits is tried again."""
_TURN_S = 0.05
"""Time between two turns of the serving thread, and between two looks whether a hang is over."""
_OPTIONS = (("grpc.max_receive_message_length", -1), ("grpc.max_send_message_length", -1), ("grpc.so_reuseport", 0))
"""Messages of any length, as NI's server takes them by default, and a port of one's own."""


class GrpcModel(Protocol):
    """A driver behind a server: a pure state machine that is given calls and a time. No threads, no waiting."""

    def serves(self, rpc: str) -> bool:
        """Whether the model knows a call."""

    def came(self, rpc: str) -> None:
        """Note that a call came."""

    def call(self, call: Call, now_s: float) -> dict[str, Any] | None:
        """Fields of the answer to a call; None: not yet, the same call comes again later. Raises `DaqmxError`."""

    def advance(self, now_s: float) -> None:
        """Let time pass."""


class GrpcServer(WireServer[GrpcModel]):
    """A server for any number of clients. Unplugging puts it out of reach, but tasks run on, since the card keeps its
    power. Raises DeviceError if the packages are not installed.
    """

    def __init__(self, model: GrpcModel, *, clock: Clock | None = None) -> None:
        super().__init__(model, clock)
        self._grpc, self._messages = _packages()
        self._port = 0
        self._server: Any = None
        self._workers: ThreadPoolExecutor | None = None

    @property
    def address(self) -> str:
        """Address at which a client finds the server."""
        return f"{HOST}:{self._port}"

    def plug(self) -> None:
        """Listen: on any free port the first time, later on the same one."""
        if self._server is not None:
            return
        self._workers = ThreadPoolExecutor(WORKERS, "GrpcServer")
        self._server = self._grpc.server(self._workers, options=_OPTIONS)
        service = self._messages.DESCRIPTOR.services_by_name["NiDAQmx"]
        handlers = {method.name: self._handler(method) for method in service.methods if self.model.serves(method.name)}
        self._server.add_generic_rpc_handlers(
            (self._grpc.method_handlers_generic_handler(service.full_name, handlers),)
        )
        self._port = self._server.add_insecure_port(self.address)
        self._server.start()

    def unplug(self) -> None:
        """Stop listening. Calls under way fail, and so do new ones."""
        server, workers = self._server, self._workers
        if server is None or workers is None:
            return
        self._server = self._workers = None  # ends waiting calls, too
        server.stop(None).wait()
        workers.shutdown()

    def _serve(self) -> None:
        while not self._ending.wait(_TURN_S):
            with self.lock:
                self.model.advance(self._now_s())

    def _handler(self, method: Any) -> Any:
        request, answer = (getattr(self._messages, one.name) for one in (method.input_type, method.output_type))

        def serve(message: Any, context: Any) -> Any:
            return self._answer(method.name, message, context, answer)

        return self._grpc.unary_unary_rpc_method_handler(
            serve, request_deserializer=request.FromString, response_serializer=answer.SerializeToString
        )

    def _answer(self, rpc: str, message: Any, context: Any, answer: Callable[..., Any]) -> Any:
        """Serve a call, in one of the workers."""
        while self._hung and self._server is not None:
            self._ending.wait(_TURN_S)
        call = Call(rpc, _fields(message), self._now_s())
        with self.lock:
            self.model.came(rpc)
        found: dict[str, Any] | None = None
        try:
            while found is None:
                if self._server is None or not context.is_active():
                    context.abort(self._grpc.StatusCode.UNAVAILABLE, "the server ends")
                with self.lock:
                    found = self.model.call(call, self._now_s())
                if found is None:
                    self._clock.sleep(_POLL_S)
        except DaqmxError as error:
            trailing = [("ni-error", str(error.code))]
            if rpc.startswith("Write"):
                trailing.append(("ni-samps-per-chan-written", str(error.written)))
            context.set_trailing_metadata(trailing)
            context.abort(self._grpc.StatusCode.UNKNOWN, str(error))
        assert found is not None, "an abort raises"
        name = found.pop("task", None)
        response = answer(**found)
        if name is not None:
            response.task.name = name
        return response


def _fields(message: Any) -> Mapping[str, Any]:
    """Fields of a request: without the ending `_raw`, a task as its name, repeated numbers as an array."""
    found: dict[str, Any] = {}
    names = [field.name for field in message.DESCRIPTOR.fields]
    for name in names:
        if f"{name}_raw" in names:
            continue
        value = getattr(message, name)
        if name == "task":
            value = value.name
        elif name == "write_array" and not isinstance(value, bytes):
            value = np.array(value)
        found[re.sub("_raw$", "", name)] = value
    return found


def _packages() -> tuple[Any, Any]:
    """The modules of grpc and of the messages. Raises DeviceError if one is not installed."""
    try:
        import grpc
        from nidaqmx._stubs import nidaqmx_pb2
    except ImportError as error:
        raise DeviceError(
            f"an emulated NI card needs the packages of spadrig[nidaq] ({error}): {install_command('nidaqmx')}"
        ) from error
    return grpc, nidaqmx_pb2
