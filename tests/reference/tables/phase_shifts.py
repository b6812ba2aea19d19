"""Sinusoidal phase shift with 3 to 8 shifts before a street, in the same time each: what the number of shifts does.

Run `python -m tests.reference.tables.phase_shifts`. For photons alone, theory says that it does nothing: the phase has
the variance 2 / N for N photons in all (`rig.strategies.patterns.phase_shift`).
"""

from __future__ import annotations

import argparse
from itertools import product
from typing import Literal

from rig.config.files import load_config, portable_content
from rig.config.overrides import SIMULATED
from rig.strategies.apparatus import Budget
from rig.strategies.comparison.scene import OpenScene, Place, open_scene
from rig.strategies.comparison.score import score
from rig.strategies.patterns.levels import Camera
from rig.strategies.patterns.phase_shift import FEWEST_SHIFTS, MOST_SHIFTS, PhaseShift
from rig.strategies.strategy import TooShort
from tests.reference.tables.printed import Table

ROWS = 32
AIRS = "clear", "50m", "20m"
CAMERAS: tuple[Camera, ...] = "spad", "camera"
UNWRAPS: tuple[Literal["none", "gray"], ...] = "none", "gray"
TIMES_S = 0.05, 1.0
SEED = 0


def right_percent(scene: OpenScene, strategy: PhaseShift, time_s: float) -> str:
    """Share of pixels within 2 % of the depth, in %; '-' if the time is too short."""
    try:
        answer = strategy.measure(scene.apparatus("energy", SEED), scene.geometry, Budget(time_s), SEED)
    except TooShort:
        return "-"
    return f"{100 * score(answer, scene.truth, scene.geometry, scene.scored).good:.0f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    numbers = range(FEWEST_SHIFTS, MOST_SHIFTS + 1)
    config = portable_content(load_config(SIMULATED))
    table = Table(["air, time, picked up by, Gray code", *(f"{shifts} shifts" for shifts in numbers)])
    for air in AIRS:
        scene = open_scene(config, Place("street", "street", air, ROWS, None))
        for time_s, camera, unwrap in product(TIMES_S, CAMERAS, UNWRAPS):
            ways = [PhaseShift("phase", "", camera, unwrap, shifts) for shifts in numbers]
            how = f"{air}, {1e3 * time_s:g} ms, {camera}, {'yes' if unwrap == 'gray' else 'no'}"
            table.add([how, *(right_percent(scene, way, time_s) for way in ways)])


if __name__ == "__main__":
    main()
