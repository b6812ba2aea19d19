"""The real laser drivers on emulated wires, as cases of the conformance suite."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from sim_backend.wire.firmware.cobolt import CoboltModel
from sim_backend.wire.firmware.obis import ObisModel
from tests.conformance.cases import LaserCase
from tests.wire.lasers import open_cobolt, open_obis, wire


@contextmanager
def cobolt(folder: Path, *args: Any, **settings: Any) -> Iterator[LaserCase]:
    model = CoboltModel(*args, **settings)
    with wire(model) as (_, surroundings), open_cobolt(surroundings) as device:
        yield LaserCase(device, surroundings.clock, lambda: model.emitting)
        assert not model.forbidden


@contextmanager
def obis(folder: Path, *, channel: int | None = None, **settings: Any) -> Iterator[LaserCase]:
    model = ObisModel(channel=channel, cdrh_delay_s=0.5, **settings)
    with wire(model) as (_, surroundings), open_obis(surroundings, channel=channel) as device:
        yield LaserCase(device, surroundings.clock, lambda: model.emitting)
        assert not model.forbidden


EMULATED_LASERS: dict[str, Callable[[Path], AbstractContextManager[LaserCase]]] = {
    "cobolt 06-MLD": cobolt,
    "cobolt 06-MLD without autostart": partial(cobolt, autostart=False),
    "cobolt 06-01": partial(cobolt, family="06-01"),
    "obis": obis,
    "obis without handshake": partial(obis, handshake=False),
    "obis, cold": partial(obis, warm_up_s=3.0),
    "obis behind a remote": partial(obis, channel=2),
}
