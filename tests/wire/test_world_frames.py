"""Frames of the emulated world: time in a moving scene counts from the world's beginning, as in a simulated one."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.clock import VirtualClock, now_s
from sim_backend.wire.emulated_world import WorldFrames
from sim_backend.wire.firmware.spb_usb_run import Span


def test_a_moving_scene_moves_from_the_world_s_beginning_however_long_the_host_has_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = VirtualClock()
    clock.sleep(10_000.0)
    seen: list[Any] = []
    state = SimpleNamespace(share=np.ones(4))
    world: Any = SimpleNamespace(
        bench=SimpleNamespace(spad_start_s=0.0),
        during=lambda start_s, *_: (state, np.ones(len(start_s))),
        mirror_positions=lambda *_: np.zeros(4),
        size=(2, 64),
    )
    frames = WorldFrames(world, clock)
    photons = SimpleNamespace(expose=lambda first, held, power, x0, bits, time_s: seen.append(time_s))
    monkeypatch.setattr(frames, "_source", lambda _: photons)
    monkeypatch.setattr(frames, "_markers", SimpleNamespace(record=lambda *_: 0))
    clock.sleep(0.5)
    records = np.zeros(4, [("x0", np.int32)])
    frames.expose(Span(2, 4, now_s(clock), 1e-5, 1e-5, None), records, np.zeros((4, 2, 8), np.uint8))
    assert seen[0] == pytest.approx(0.5 + 1e-5 * np.arange(4))
    assert world.bench.spad_start_s == pytest.approx(0.5 - 2e-5)
