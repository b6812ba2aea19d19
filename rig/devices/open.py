"""Opens all devices of a rig together, lists every failure at once, and closes them gate first, whatever happens.

It also checks that the user consents to light (`arm`), as a real laser or gate requires; a simulated one does not.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

from calibration.errors import CalibrationError
from calibration.files.rig_file import load_rig_model
from calibration.model.rig_model import RigModel
from drivers.clock import Clock, SystemClock, VirtualClock
from drivers.errors import DeviceError, DeviceTimeout, NoAnswer, ProtocolError
from drivers.guard import Guard, require_linux
from drivers.interfaces import BeamScanner, LineLaser, SpadArray, SyncSource, World
from drivers.lasers.serial_laser import OFF_TIMES
from drivers.registry import KindConfig, Surroundings, lookup
from drivers.transports.endpoints import EMULATED_PREFIX, Endpoint
from drivers.transports.serial_port import configured_port
from drivers.transports.tap import Tap, TapFile
from rig.config.models import RigConfig
from rig.errors import DevicesError, UsageError
from rig.progress import tell_stage
from rig.recording.cube import cube_columns

GUARDED = ("laser", "sync")
"""Slots of the devices that let light out. If they are real, a separate process (the guard) owns them."""
DEVICES = ("spad", "scanner", "laser", "sync")
"""Slots of devices, in the order in which they are opened."""


@dataclass(frozen=True, slots=True)
class OpenRig:
    """The open devices of a rig. world: None for a real rig. model: None if the rig is not calibrated."""

    config: RigConfig
    clock: Clock
    world: World | None
    spad: SpadArray
    scanner: BeamScanner
    laser: LineLaser
    sync: SyncSource
    model: RigModel | None
    guard: Guard | None = None
    """The process that owns the ports of a real laser and its gate."""
    seed: int = 0
    """Seed of everything simulated."""


@runtime_checkable
class ProjectsLines(Protocol):
    """A world whose laser can project several lines at once."""

    def project_lines(self, offsets: Sequence[float], *, shared: bool) -> None:
        """Project lines at these offsets, in units of the mirror command. shared: whether they share the power."""
        ...


@runtime_checkable
class EmulatesDevices(Protocol):
    """A world that provides devices of its own, until it is closed."""

    @property
    def ports(self) -> Mapping[str, Endpoint]:
        """Endpoints of the devices, by the NAME in `port: emulated:NAME`."""
        ...

    def close(self) -> None:
        """Unplug all devices."""
        ...


@contextmanager
def open_rig(config: RigConfig, seed: int = 0, tap: TapFile | None = None) -> Iterator[OpenRig]:
    """Open every device of the config; on exit the sync source is closed first, then laser, scanner and SPAD.

    A simulated rig has virtual time; a real one, or a simulated one that works in real time, has the host's.
    seed: the seed of everything simulated.
    tap: file that records what passes the ports of all devices; for the SPAD, only its control traffic.
    Raises UsageError for faults of config or calibration, DevicesError for faults of devices; each lists all problems.
    Raises DeviceError for a laser or gate that must be guarded, where no guard can run.
    """
    if any(getattr(config, slot).real_time for slot in GUARDED):
        require_linux()  # before anything is opened
    with ExitStack() as stack:
        yield _open(config, seed, tap, stack)


@contextmanager
def open_light(config: RigConfig, trouble: list[str]) -> Iterator[tuple[SyncSource | None, LineLaser | None]]:
    """A context with only the gate and the laser open, without a guard. A device that fails is None and adds a line to
    `trouble`. If it fails by not answering, and its kind has bytes that switch it off, these are sent all the same: it
    may still receive.

    Raises DeviceError if the config has a simulated world and this cannot be made.
    """
    with ExitStack() as stack:
        surroundings = surroundings_of(config, 0, stack)
        opened: dict[str, Any] = {"sync": None, "laser": None}
        for slot in reversed(GUARDED):  # the gate first: some lasers take seconds to open
            try:
                opened[slot] = stack.enter_context(_create(slot, getattr(config, slot), surroundings))
            except Exception as error:  # an error of one device must not keep the other one on
                silent = isinstance(error, NoAnswer | DeviceTimeout | ProtocolError)
                told = _told_off(slot, getattr(config, slot), surroundings) if silent else ""
                trouble.append(f"{slot}: {error}{told}")
        yield opened["sync"], opened["laser"]


def _told_off(slot: str, config: KindConfig, surroundings: Surroundings) -> str:
    """Send the bytes that switch off to a device that does not answer; returns what to say about it."""
    kind = lookup(slot, config.kind)
    if kind.off is None:
        return ""
    try:
        with closing(configured_port(slot, config, surroundings.ports)) as port:
            port.write_again(kind.off(config), OFF_TIMES)
    except Exception:
        return ""  # the first error says what is wrong
    return " (it was told to switch off all the same; look whether it is dark)"


def check_files(config: RigConfig) -> None:
    """Check every file that a config names, as `open_rig` would, but open no device. Raises UsageError with a line for
    each problem."""
    problems: list[str] = []
    _load_model(config, problems)
    with ExitStack() as stack:
        _create_surroundings(config, 0, stack, problems)
    for slot in DEVICES:
        kind = getattr(config, slot)
        check = lookup(slot, kind.kind).check_files
        try:
            if check is not None:
                check(kind)
        except DeviceError as error:
            problems += [f"{slot}: {line}" for line in str(error).splitlines()]
    if problems:
        raise UsageError.of(problems)


def _open(config: RigConfig, seed: int, tap: TapFile | None, stack: ExitStack) -> OpenRig:
    usage: list[str] = []
    devices: list[str] = []
    model = _load_model(config, usage)
    surroundings = _create_surroundings(config, seed, stack, usage)
    opened: dict[str, Any] = {}
    guard: Guard | None = None
    if surroundings is not None:
        light = {slot: kind for slot in GUARDED if (kind := getattr(config, slot)).real_time}
        guard = stack.enter_context(Guard(**light, ports=surroundings.ports, tap=tap)) if light else None
        # Closing runs backwards: the gate goes low before the laser pauses, the mirror parks and the SPAD stops.
        for slot in DEVICES:
            tell_stage("opening devices", note=slot)
            try:
                if guard is not None and slot in light:
                    device: Any = guard.laser if slot == "laser" else guard.sync
                else:
                    device = _create(slot, getattr(config, slot), _tapped(surroundings, slot, tap, stack))
                opened[slot] = stack.enter_context(device)
            except DeviceError as error:
                devices.append(f"{slot}: {error}")
    if "laser" in opened:
        devices += _pause_if_emitting(opened["laser"])
        if opened["laser"].gate_only and "sync" not in opened:
            devices.append(f"laser: only that gate ends the light of {opened['laser'].name}: switch it off by hand")
    if usage:
        raise UsageError(*usage, *devices)
    if devices:
        raise DevicesError("\n".join(devices))
    assert surroundings is not None, "else there is trouble"
    clock, world = surroundings.clock, surroundings.world
    return OpenRig(config=config, clock=clock, world=world, model=model, guard=guard, seed=seed, **opened)


def _create_surroundings(config: RigConfig, seed: int, stack: ExitStack, problems: list[str]) -> Surroundings | None:
    """Clock and world; None if the world cannot be made, with lines in `problems`."""
    try:
        return surroundings_of(config, seed, stack)
    except DeviceError as error:  # a scene that is not there is the config's fault, not a device's
        problems += [f"world: {line}" for line in str(error).splitlines()]
        return None


def surroundings_of(config: RigConfig, seed: int, stack: ExitStack) -> Surroundings:
    """Clock, world and the ports of devices that the world emulates. Raises DeviceError if the world cannot be made.

    stack: unplugs the emulated devices when it is closed.
    """
    virtual = config.world is not None and not config.world.real_time
    clock = VirtualClock() if virtual else SystemClock()
    bare = Surroundings(clock, None, seed)
    if config.world is None:
        return bare
    world = _create("world", config.world, bare)
    if isinstance(world, ProjectsLines):
        world.project_lines(config.line_offsets, shared=config.line_power == "shared")
    found = replace(bare, world=world)
    if isinstance(world, EmulatesDevices):
        stack.callback(world.close)
        found = replace(found, ports=world.ports)
    return found


def _tapped(surroundings: Surroundings, slot: str, file: TapFile | None, stack: ExitStack) -> Surroundings:
    """Surroundings with a tap for a slot's device, if traffic is recorded. It is flushed after the device is closed."""
    if file is None:
        return surroundings
    tap = Tap(file, slot)
    stack.callback(tap.flush)
    return replace(surroundings, tap=tap)


def _create(slot: str, kind: KindConfig, surroundings: Surroundings) -> Any:
    return lookup(slot, kind.kind).create(kind, surroundings)


def _load_model(config: RigConfig, problems: list[str]) -> RigModel | None:
    if config.calibration is None:
        return None
    try:
        model = load_rig_model(config.calibration)
    except CalibrationError as error:
        problems.append(f"calibration: {error}")
        return None
    if (cube_columns(model) or 0) > 2:  # up to two planes may as well be those of a mirror
        problems.append(
            f"calibration: {config.calibration} is for a bare cube ('planes', one per column); a scan needs a "
            "calibration with 'scanner', which says where the plane is at any mirror command"
        )
        return None
    return model


def _pause_if_emitting(laser: LineLaser) -> list[str]:
    """Pause a laser that emits before this program armed it. Returns the reason to refuse the scan, if there is one.

    If only the gate can end a laser's light, the laser must be on already; that it emits is then no reason."""
    try:
        if laser.gate_only or not laser.status.emission:
            return []
        laser.pause()
    except DeviceError as error:
        return [f"laser: {error}"]
    return [f"laser: {laser.name} was found emitting and has been paused; find out who armed it, then start again"]


def light_problems(config: RigConfig, arm: bool) -> list[str]:
    """Problems with letting light out: a laser or gate that is not simulated or emulated needs consent (`arm`)."""
    devices = {slot: getattr(config, slot) for slot in GUARDED}
    real = [
        slot
        for slot, device in devices.items()
        if device.real_time and not str(getattr(device, "port", "")).startswith(EMULATED_PREFIX)
    ]
    if arm or not real:
        return []
    kinds = ", ".join(f"{slot} {devices[slot].kind}" for slot in real)
    return [f"{config.name} has real light ({kinds}); clear the beam path, then add `arm=True`"]
