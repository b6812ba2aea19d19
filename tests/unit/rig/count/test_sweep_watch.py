"""Frames that came by turns from two maps, and gates and light that are late, are doubted; others are not."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.frames import Mark
from rig.count.sweep_watch import SweepWatch
from tests.stability.inventory import covers

covers(SweepWatch)

ROWS, WIDTH, COLUMNS = 32, 128, 64
BEFORE, BEHIND = 60, 60
"""Frames before the mirror enters the first column, and behind the last one."""


@dataclass(frozen=True)
class TakenSweep:
    """A sweep of a line over random surfaces. bits: (frames, rows, width). since: (frames,) middle of each exposure, in
    frames since the first column. marks: (frames,)."""

    exposures: int
    bits: NDArray[np.bool_]
    since: NDArray[np.float64]
    marks: NDArray[np.int64]
    gate: tuple[float, float]

    def doubts(self, pieces: int = 1, marked: bool = True) -> tuple[str, ...]:
        watch = SweepWatch(self.exposures, COLUMNS * self.exposures, [self.gate] if marked else ())
        number = np.arange(len(self.bits)) + 17
        lit = ((self.marks & Mark.GATE_HIGH) > 0) & (self.since > 0) & (self.since < COLUMNS * self.exposures)
        bits = np.packbits(self.bits, axis=2)
        for part in np.array_split(np.arange(len(number)), pieces):
            x0 = np.zeros(len(part), np.int32)
            watch.add(bits[part], number[part], lit[part], x0, self.since[part], self.marks[part])
        return watch.finish()


def sweep(
    seed: int, exposures: int, *, scene: int | None = None, first: float = -1.0, late: float = 0.0, glow: float = 0.0,
    photons: float = 0.3, hot: float = 0.0, brighter: float = 0.0,
) -> TakenSweep:  # fmt: skip
    """A sweep. scene: seed of its surfaces. first: share of the columns before any surface. late: frames by which the
    light follows the gate. glow: frames for which it goes on. hot: share of hot pixels. brighter: every other frame."""
    rng, surfaces = np.random.default_rng(seed), np.random.default_rng(seed if scene is None else scene)
    phase = rng.uniform(0, 1)
    since = np.arange(-BEFORE, COLUMNS * exposures + BEHIND) + phase
    opens, closes = -1.0 - rng.uniform(0, 0.5), COLUMNS * exposures + 1.0 + rng.uniform(0, 0.5)
    start, end = since - 0.5, since + 0.5
    inside = ((start < opens) & (end > opens)) | ((start < closes) & (end > closes))
    marks = np.where(inside, int(Mark.GATE_EDGE), np.where((since > opens) & (since < closes), int(Mark.GATE_HIGH), 0))
    shift = np.repeat(surfaces.integers(0, 40, (ROWS, 4)), COLUMNS // 4, axis=1)
    albedo = np.repeat(surfaces.uniform(0.2, 1.0, (ROWS, 8)), COLUMNS // 8, axis=1)
    column = np.clip(since / exposures, 0, COLUMNS - 1).astype(int)
    place = 20 + since[:, None] / exposures + shift[:, column].T
    share = np.clip(since - opens - late + 0.5, 0, 1) * np.clip(closes + late + glow - since + 0.5, 0, 1)
    share = share * (since >= first * COLUMNS * exposures)
    line = (
        np.exp(-((np.arange(WIDTH) - place[:, :, None]) ** 2) / 2) * (albedo[:, column].T * share[:, None])[:, :, None]
    )
    pixels = np.where(rng.random((ROWS, WIDTH)) < hot, 0.7, 0.01)
    power = 1.0 + brighter * (np.arange(len(since)) % 2)
    chance = 1 - np.exp(-(photons * power[:, None, None] * line + pixels))
    return TakenSweep(
        exposures, rng.random(chance.shape, np.float32) < chance, since, marks.astype(np.int64), (opens, closes)
    )


@pytest.mark.parametrize("exposures", [1, 2, 3, 4, 6, 10])
def test_right_frames_are_not_doubted(exposures: int) -> None:
    for seed in range(7):  # 42 in all
        rng = np.random.default_rng([seed, exposures])
        taken = sweep(
            100 * exposures + seed, exposures, photons=float(rng.choice([0.0, 0.02, 0.3, 3.0])), hot=0.02 * (seed % 2),
            first=float(rng.choice([-1.0, 0.03])), brighter=float(rng.choice([0.0, 0.2])),
        )  # fmt: skip
        assert taken.doubts() == ()


@pytest.mark.parametrize("exposures", [2, 3, 10])
@pytest.mark.parametrize("what", ["frames", "columns"])
def test_frames_of_two_maps_by_turns_are_doubted(exposures: int, what: str) -> None:
    for seed in (1, 2):
        one = sweep(seed, exposures, photons=2.0, hot=0.01)
        other = sweep(seed, exposures, scene=50 + seed, photons=2.0, hot=0.01)
        turn = np.floor(one.since / (1 if what == "frames" else exposures)).astype(int) % 2 == 1
        mixed = TakenSweep(
            exposures, np.where(turn[:, None, None], other.bits, one.bits), one.since, one.marks, one.gate
        )
        (doubt,) = mixed.doubts(marked=seed == 1)
        assert doubt.startswith(f"frames of two maps seem mixed: {what} have")


@pytest.mark.parametrize("exposures", [2, 3, 5, 10])
def test_pixels_half_a_column_late_or_early_are_doubted(exposures: int) -> None:
    half = exposures // 2
    for seed, by in ((1, half), (2, half), (3, -half)):
        taken = sweep(seed, exposures, photons=3.0)
        late = TakenSweep(exposures, np.roll(taken.bits, by, axis=0), taken.since, taken.marks, taken.gate)
        (doubt,) = late.doubts()
        assert doubt.startswith("the light begins and ends")
        assert ("later than the gate" if by > 0 else "earlier than the gate") in doubt


@pytest.mark.parametrize("exposures", [6, 10, 16])
def test_a_cube_whose_first_frames_are_of_another_place_is_doubted(exposures: int) -> None:
    for seed in range(3):
        taken = sweep(seed, exposures, photons=3.0)
        there = np.flatnonzero((taken.since > 0) & (taken.since < COLUMNS * exposures))
        for by in (0, exposures // 2):
            watch, bits = SweepWatch(exposures, len(there)), np.packbits(np.roll(taken.bits[there], by, axis=0), axis=2)
            watch.add(bits, np.arange(len(bits)), np.ones(len(bits), np.bool_), np.zeros(len(bits), np.int32))
            doubts = watch.finish()
            assert len(doubts) == (by > 0), (seed, by, doubts)
            for doubt in doubts:
                assert abs(int(doubt.split()[2]) - by) <= 1, doubt


def test_an_edge_of_a_surface_in_the_first_column_is_not_doubted() -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        exposures = int(rng.choice([4, 8, 16]))
        at = rng.uniform(0, 1) / COLUMNS
        taken = sweep(seed, exposures, photons=3.0)
        # Before it is another surface, or none.
        other = sweep(seed, exposures, photons=3.0 * (seed % 2), scene=90 + seed)
        # The line, 1 px wide, is on both surfaces while it passes the edge.
        passed = np.clip((taken.since / exposures - at * COLUMNS) / 2.35 + 0.5, 0, 1)[:, None, None]
        bits = np.where(rng.random(taken.bits.shape, np.float32) < passed, taken.bits, other.bits)
        there = np.flatnonzero((taken.since > 0) & (taken.since < COLUMNS * exposures))
        watch, packed = SweepWatch(exposures, len(there)), np.packbits(bits[there], axis=2)
        watch.add(packed, np.arange(len(there)), np.ones(len(there), np.bool_), np.zeros(len(there), np.int32))
        assert watch.finish() == ()


@pytest.mark.parametrize("exposures", [1, 2, 3, 10])
def test_late_markers_are_doubted(exposures: int) -> None:
    for seed in (4, 5):
        taken, by = sweep(seed, exposures), max(exposures / 2, 1.5)
        (doubt,) = TakenSweep(exposures, taken.bits, taken.since - by, taken.marks, taken.gate).doubts()
        assert doubt.startswith("the gate opens and closes")
        assert "earlier than the plan says" in doubt


@pytest.mark.parametrize("exposures", [2, 6])
def test_a_laser_that_follows_its_gate_by_a_little_or_glows_on_is_not_doubted(exposures: int) -> None:
    for seed in range(3):
        assert sweep(seed, exposures, late=0.25, photons=3.0).doubts() == ()
        assert sweep(seed, exposures, glow=3.0, photons=3.0).doubts() == ()


def test_a_known_delay_of_the_light_is_none() -> None:
    taken = sweep(7, 5, late=2.0, photons=3.0)
    assert taken.doubts()
    watch = SweepWatch(5, COLUMNS * 5, [taken.gate], delay=2.0)
    bits, number = np.packbits(taken.bits, axis=2), np.arange(len(taken.bits))
    lit = (taken.marks & Mark.GATE_HIGH) > 0
    watch.add(bits, number, lit, np.zeros(len(number), np.int32), taken.since, taken.marks)
    assert watch.finish() == ()


def test_blocks_and_earlier_sweeps_change_nothing_and_lost_frames_say_nothing() -> None:
    one, other = sweep(8, 4), sweep(8, 4, scene=60)
    turn = (np.arange(len(one.since)) % 2 == 1)[:, None, None]
    mixed = TakenSweep(4, np.where(turn, other.bits, one.bits), one.since, one.marks, one.gate)
    assert mixed.doubts(1) == mixed.doubts(7) == mixed.doubts(50) != ()
    watch = SweepWatch(4, COLUMNS * 4)
    for taken, doubted in ((mixed, True), (one, False), (mixed, True)):
        bits, number = np.packbits(taken.bits, axis=2), np.arange(len(taken.bits))
        watch.add(bits, number, number >= BEFORE, np.zeros(len(number), np.int32))
        assert bool(watch.finish()) == doubted
    kept = np.arange(0, len(mixed.bits), 3)
    watch.add(np.packbits(mixed.bits, axis=2)[kept], kept, kept >= BEFORE, np.zeros(len(kept), np.int32))
    assert watch.finish() == ()
    assert watch.finish() == ()


def test_one_of_so_many_sweeps_is_watched_and_the_first_among_them() -> None:
    one, other = sweep(8, 4), sweep(8, 4, scene=60)
    turn = (np.arange(len(one.since)) % 2 == 1)[:, None, None]
    bits, number = np.packbits(np.where(turn, other.bits, one.bits), axis=2), np.arange(len(one.since))
    watch, found = SweepWatch(4, COLUMNS * 4, every=3), []
    for _ in range(7):
        watch.add(bits, number, number >= BEFORE, np.zeros(len(number), np.int32))
        found.append(bool(watch.finish()))
    assert found == [True, False, False, True, False, False, True]
