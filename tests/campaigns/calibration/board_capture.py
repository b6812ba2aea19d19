"""A random rig's sweeps over a board, frame by frame through the simulator's photons and the scan's counting.

What a scan does with devices, without the devices: the mirror runs evenly over the part of its range that meets the
board, `frames` of 10 us follow one another, a column's light stands where the mirror is on the mean of its frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.arrays import Array
from rig.count.volume import CountVolume, SweepCounter, SweepLayout
from rig.threads import RowWorkers
from sim_backend.effects.dark_counts import dark_rates
from sim_backend.effects.setting import FrameTimes, Setting
from sim_backend.frames.flux import FluxModel
from sim_backend.frames.photons import PhotonSource
from sim_backend.light.optics import Line, Optics, Sensor, detections_per_radiance
from sim_backend.light.view import make_view
from sim_backend.mirror_motion import Jitter
from sim_backend.scenes.board import BoardAtPose, board_scene
from sim_backend.scenes.scene import SceneFile
from tests.reference.boards.random_rigs import COMMAND_REACH, RandomRig, paper

FRAME_S = 1e-5
COLUMNS = 800
"""Over the mirror's whole range: about a pixel each."""
WALL_M, BEHIND_M = 4.0, 0.5
"""Distance of the wall, and its least distance behind the boards."""
SPARE_COLUMNS = 10
HOT_PER_S = 500.0
"""Dark counts above which a calibration of the pixels calls one defective."""
BATCH = 256


def speed(exposures: int) -> float:
    """Speed of the command, per second, with so many frames to a column."""
    return 2 * COMMAND_REACH / (COLUMNS * exposures * FRAME_S)


@dataclass(frozen=True, slots=True)
class SweepAsked:
    """A sweep to make. phase_wave: by how many columns frames drift against the mirror and back along the sweep, for
    exposures that are not locked to the scan."""

    exposures: int = 10
    direction: int = 1
    phase_wave: float = 0.0

    @property
    def speed_per_s(self) -> float:
        """Speed of the command, above 0."""
        return speed(self.exposures)


@dataclass(frozen=True, slots=True, eq=False)
class SweepTaken:
    """A sweep's counts and what the plan says of it. command: (columns,) mean over each column's frames, lag 0."""

    volume: CountVolume
    command: Array
    asked: SweepAsked


@dataclass(frozen=True, slots=True, eq=False)
class Stand:
    """A rig at which boards are held up. rays: its camera's tangents; dark_per_s: (rows, width), dark counts as a
    calibration of the pixels finds them. Both are the same at every pose and take time to find."""

    rig: RandomRig
    rays: tuple[Array, Array]
    dark_per_s: Array

    @property
    def sensor(self) -> Sensor:
        """The rig's own."""
        return Sensor(pixel_seed=self.rig.pixel_seed)


def set_up(rig: RandomRig) -> Stand:
    """The rig, ready for boards."""
    rays = rig.model.camera.tangents()
    return Stand(rig, rays, dark_rates(Sensor(pixel_seed=rig.pixel_seed), rays[0].shape))


def take_sweeps(
    stand: Stand, shown: Sequence[BoardAtPose], sweeps: Sequence[SweepAsked], rng: np.random.Generator
) -> list[SweepTaken]:
    """Sweep the line over the boards."""
    rig, camera = stand.rig, stand.rig.model.camera
    ambient = {"ambient": {"illuminance": f"{rig.illuminance_lux!r} lux"}}
    optics, sensor, line = Optics(), stand.sensor, Line()
    gain = detections_per_radiance(optics, sensor, line)
    points = np.concatenate([paper(one.board, one.pose) for one in shown])
    wall_m = max(WALL_M, float(points[:, 2].max()) + BEHIND_M)
    view = make_view(rig.model, board_scene(*stand.rays, shown, wall_m), rays=stand.rays)
    light = FluxModel(Setting(view, SceneFile.model_validate(ambient), optics, sensor, line, gain))
    first, last, x0, window = _where(rig, points)
    seed = int(rng.integers(1 << 62))
    source = PhotonSource(light, rig.model.sheets, FrameTimes(FRAME_S, FRAME_S), seed, 1)
    taken, frame = [], 0
    try:
        for asked in sweeps:
            columns = np.arange(first, last + 1)[:: asked.direction]
            mirror, mean = _motion(rig, columns, asked, frame * FRAME_S, rng)
            count = last - first + 1
            layout = SweepLayout(
                count, camera.height, camera.width, np.full(count, x0, np.int32), window, asked.exposures, dark=False
            )
            counter = SweepCounter(layout, RowWorkers(1))
            held, bins = np.repeat(mirror, asked.exposures), np.repeat(columns - first, asked.exposures)
            for a in range(0, len(held), BATCH):
                part = slice(a, a + BATCH)
                n = len(held[part])
                bits = np.zeros((n, camera.height, layout.padded_width // 8), np.uint8)
                zero = np.zeros(n, np.int32)
                source.expose(frame, held[part], np.full(n, rig.power_w), zero, bits, np.zeros(n))
                counter.add(bits, bins[part].astype(np.int32), bins[part].astype(np.float64), zero)
                frame += n
            taken.append(SweepTaken(counter.finish(), mean[:: asked.direction], asked))
    finally:
        source.close()
    return taken


def _motion(
    rig: RandomRig, columns: NDArray[np.int64], asked: SweepAsked, start_s: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """(mirror position, command that the plan has) of columns in the order in which they are swept."""
    step = 2 * COMMAND_REACH / COLUMNS
    frames = asked.exposures
    mean = -COMMAND_REACH + (columns.astype(np.float64) + 0.5 + rng.uniform(-0.5, 0.5) / frames) * step
    times = start_s + rng.uniform(0, 1) + np.arange(len(columns) * frames, dtype=np.float64) * FRAME_S
    shaken = Jitter(rig.jitter, rig.pixel_seed).error(times).reshape(-1, frames).mean(axis=1)
    lag_s = rig.model.lag_s.forward if asked.direction > 0 else rig.model.lag_s.backward
    turns = rng.uniform(1.0, 3.0) * np.linspace(0, 2 * np.pi, len(columns)) + rng.uniform(0, 2 * np.pi)
    drift = asked.phase_wave * step * np.sin(turns)
    return mean - asked.direction * asked.speed_per_s * lag_s + shaken + drift, mean


def _where(rig: RandomRig, points: Array) -> tuple[int, int, int, int]:
    """First and last column that meet a board, with some to spare; first pixel and width of what is counted."""
    x, _ = rig.model.camera.project(points)
    width = -(-rig.model.camera.width // 64) * 64
    x0 = max(0, int(np.nanmin(x)) - 8) // 64 * 64
    end = min(width, -(-(int(np.nanmax(x)) + 9) // 64) * 64)
    at = np.arange(COLUMNS)
    planes = rig.model.planes(-COMMAND_REACH + (at + 0.5) * (2 * COMMAND_REACH / COLUMNS))
    side = planes[:, :3] @ points.T > planes[:, 3:]
    met = at[side.any(axis=1) & ~side.all(axis=1)]
    # A column's light comes from where the mirror was a lag ago: up to 6 columns at the fastest.
    first, last = int(met.min()) - SPARE_COLUMNS, int(met.max()) + SPARE_COLUMNS
    return max(0, first), min(COLUMNS - 1, last), x0, end - x0
