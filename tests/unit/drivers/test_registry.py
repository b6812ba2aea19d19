"""Kinds by name: what is installed, what is unknown, what is no kind."""

from importlib.metadata import EntryPoint

import pytest
from pydantic import ValidationError

from drivers import registry
from drivers.clock import VirtualClock
from drivers.errors import UnknownKind
from drivers.registry import Kind, KindConfig, Surroundings, kinds, lookup


class LampConfig(KindConfig):
    watts: int = 1


LAMP = Kind(LampConfig, lambda config, surroundings: (config.watts, surroundings.seed))
NO_KIND = object()


INSTALLED = (
    *(("lamp", "LAMP"), ("broken", "NO_KIND"), ("arc", "LAMP"), ("gone", "NOT_THERE")),
    *(("twice", "LAMP"), ("twice", "NO_KIND"), ("same", "LAMP"), ("same", "LAMP")),
)


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def added(group: str) -> tuple[EntryPoint, ...]:
        known = INSTALLED if group == "spadrig.laser" else ()
        return tuple(EntryPoint(name, f"{__name__}:{value}", group) for name, value in known)

    monkeypatch.setattr(registry, "added", added)


def test_kinds_are_listed_once_and_sorted_and_one_that_is_found_creates_its_device() -> None:
    assert kinds("laser") == ("arc", "broken", "gone", "lamp", "same", "twice")
    assert kinds("spad") == ()
    with pytest.raises(ValueError, match="no slot 'camera'"):
        kinds("camera")
    kind = lookup("laser", "lamp")
    device = kind.create(kind.config(kind="lamp", watts=3), Surroundings(VirtualClock(), None, seed=4))
    assert device == (3, 4)
    assert lookup("laser", "same") is kind


@pytest.mark.parametrize(
    ("slot", "kind", "said"),
    [
        ("laser", "lmap", "laser: unknown kind 'lmap'; choose one of: arc, broken, gone, lamp, same, twice"),
        ("spad", "lamp", "none installed"),
        ("laser", "broken", r"no drivers\.registry\.Kind, but of type object"),
        ("laser", "gone", "'gone' cannot be loaded from .*NOT_THERE"),
        ("laser", "twice", "offered twice"),
    ],
)
def test_a_kind_that_is_unknown_or_cannot_be_used_is_refused(slot: str, kind: str, said: str) -> None:
    with pytest.raises(UnknownKind, match=said):
        lookup(slot, kind)


def test_a_kinds_config_takes_no_stray_keys_and_does_not_change() -> None:
    with pytest.raises(ValidationError, match="wats"):
        LampConfig.model_validate({"kind": "lamp", "wats": 3})
    with pytest.raises(ValidationError, match="frozen"):
        LampConfig(kind="lamp").watts = 3  # type: ignore[misc]
