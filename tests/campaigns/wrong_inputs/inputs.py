"""The wrong inputs. Each takes a setting and gives the run of an input that looks right, and what depth is to be."""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.files.rig_file import load_rig_model, save_rig_model
from calibration.model.rig_model import Identity
from rig.scan.run import RunResult
from tests.campaigns.wrong_inputs.recorded import GATE_HIGH, PER_FRAME, Recording
from tests.campaigns.wrong_inputs.setting import Content, Cube, Setting, changed, truths, write_yaml

Truth = list[NDArray[np.float32]]


@dataclass(frozen=True)
class Wrong:
    """A wrong input.

    what: is wrong, in words. true: the truth, or two, of which either is right. run: makes the depth. undisturbed:
    scans the same without the wrong input, and gives the recording.
    """

    what: str
    true: tuple[Truth, ...]
    run: Callable[[], RunResult]
    undisturbed: Callable[[], Path]


Make = Callable[[Setting], Wrong]


def none(setting: Setting) -> Wrong:
    """Nothing is wrong: a recording, or a cube of its frames."""
    run = setting.scan("a")
    if setting.rng.random() < 0.5:
        return Wrong("recording", (truths(run),), lambda: setting.depth(run, "depth"), lambda: run)
    cube = Cube.of(Recording(run), setting.geometry)
    return Wrong("cube", (truths(run),), lambda: cube.depth(setting, "depth"), lambda: run)


def _of_cube(setting: Setting, change: Callable[[Cube], tuple[str, Cube]]) -> Wrong:
    run = setting.scan("a")
    what, cube = change(Cube.of(Recording(run), setting.geometry))
    return Wrong(f"cube: {what}", (truths(run),), lambda: cube.depth(setting, "depth"), lambda: run)


def _of_recording(setting: Setting, change: Callable[[Recording], str], *others: Path, sealed: bool = True) -> Wrong:
    run = setting.scan("a")
    recording = Recording(shutil.copytree(run, setting.folder / "changed"))
    what = change(recording)
    recording.write(sealed=sealed)
    true = truths(run), *(truths(other) for other in others)
    return Wrong(f"recording: {what}", true, lambda: setting.depth(recording.folder, "depth"), lambda: run)


def _of_calibration(setting: Setting, what: str, wrong: Content, identity: Identity | None = None) -> Wrong:
    """The rig is as its calibration file says, but another one is used."""
    run = setting.scan("a")
    file = setting.folder / "wrong.yaml"
    write_yaml(file, wrong)
    if identity is not None:
        save_rig_model(replace(load_rig_model(file), identity=identity), file)
    return Wrong(what, (truths(run),), lambda: setting.depth(run, "depth", file), lambda: run)


def _of_world(setting: Setting, what: str, true: Content) -> Wrong:
    """The rig is not as its calibration says when it scans."""
    run = setting.scan("a", true)
    return Wrong(what, (truths(run),), lambda: setting.depth(run, "depth"), lambda: setting.scan("right"))


def _spliced(setting: Setting, what: str, after: Path, *, share: float | None = None) -> Wrong:
    """From some frame on, in the middle of a sweep, the frames of another run of the same plan. Either's depth is
    right."""

    def changes(recording: Recording) -> str:
        maps = recording.maps()
        which = int(setting.rng.integers(0 if share != 0.0 else 1, len(maps)))
        at = float(setting.rng.uniform(0.2, 0.8)) if share is None else share
        recording.take(Recording(after), slice(int(maps[which][int(at * len(maps[which]))]), None))
        return f"{what} from map {which}, {at:.2f} of its sweep on"

    return _of_recording(setting, changes, after)


def bit_order(setting: Setting) -> Wrong:
    """The least significant bit first."""

    def swapped(cube: Cube) -> tuple[str, Cube]:
        return "bits", replace(cube, frames=np.packbits(cube.bits(), axis=2, bitorder="little"))

    def in_place(recording: Recording) -> str:
        recording.pixels[:] = np.packbits(np.unpackbits(recording.pixels, axis=2), axis=2, bitorder="little")
        return "bits"

    return _of_cube(setting, swapped) if setting.rng.random() < 0.5 else _of_recording(setting, in_place)


def exposures_for_columns(setting: Setting) -> Wrong:
    """Exposures and columns swapped: in the plan, or in the order of the frames."""

    def swapped(cube: Cube) -> tuple[str, Cube]:
        if setting.rng.random() < 0.3:
            return "numbers of the plan", replace(cube, columns=cube.exposures, exposures=cube.columns)
        frames = cube.frames.reshape(-1, cube.columns, cube.exposures, *cube.frames.shape[1:])
        return "order of frames", replace(cube, frames=frames.swapaxes(1, 2).reshape(cube.frames.shape))

    return _of_cube(setting, swapped)


def columns_reversed(setting: Setting) -> Wrong:
    """The last column first."""
    return _of_cube(setting, lambda cube: ("columns", replace(cube, frames=np.ascontiguousarray(cube.frames[::-1]))))


def half_a_column_late(setting: Setting) -> Wrong:
    """Frames of a map shifted by half a column: in a cube, against all marks, or the markers against gate and light."""
    half = setting.exposures // 2

    def rolled(cube: Cube) -> tuple[str, Cube]:
        return f"{half} frames", replace(cube, frames=np.roll(cube.frames, half, axis=0))

    def pixels(recording: Recording) -> str:
        recording.pixels[:] = np.roll(recording.pixels, half, axis=0)
        return f"pixels {half} frames late"

    def markers(recording: Recording) -> str:
        recording.delay_markers(setting.exposures * PER_FRAME // 2)
        return f"markers {setting.exposures / 2} frames late"

    pick = setting.rng.integers(3)
    return _of_cube(setting, rolled) if pick == 0 else _of_recording(setting, pixels if pick == 1 else markers)


def other_calibration(setting: Setting) -> Wrong:
    """The calibration of another rig with a sensor of the same size; half of them say so, as measured ones do."""
    rng = setting.rng
    values = {
        "baseline": float(rng.choice([-1.0, 1.0]) * rng.uniform(0.7, 1.4)),
        "focal": rng.uniform(0.85, 1.15),
        "right_px": rng.uniform(-8, 8),
        "mirror": rng.uniform(0.8, 1.2),
    }
    other = changed(setting.geometry, **values)
    if values["baseline"] < 0:
        pivot = other["scanner"]["pivot"]
        pivot["angle_rad"] = [-pivot["angle_rad"][0], pivot["angle_rad"][1]]
        other = changed(other, mirror=-1.0) if rng.random() < 0.5 else other
    kinds = {"spad": "simulated", "scanner": "simulated, axis x", "geometry": "another"}
    identity = Identity("0" * 16, "2026-11-01T00:00:00+00:00", "another", kinds) if rng.random() < 0.5 else None
    what = ", ".join(f"{name} {value:.2f}" for name, value in values.items())
    return _of_calibration(setting, f"{what}{', with identity' if identity else ''}", other, identity)


def baseline_off(setting: Setting) -> Wrong:
    """A baseline 3 % too long or too short."""
    return _of_calibration(setting, *_scaled(setting, "baseline", 0.03))


def focal_length_off(setting: Setting) -> Wrong:
    """A focal length 2 % too long or too short."""
    return _of_calibration(setting, *_scaled(setting, "focal length", 0.02))


def baseline_off_before(setting: Setting) -> Wrong:
    """A rig whose baseline is not that of its calibration, which was wrong before the recording was taken."""
    return _of_world(setting, *_scaled(setting, "baseline", 0.03))


def focal_length_off_before(setting: Setting) -> Wrong:
    """A rig whose focal length is not that of its calibration, which was wrong before the recording was taken."""
    return _of_world(setting, *_scaled(setting, "focal length", 0.02))


def _scaled(setting: Setting, length: str, by: float) -> tuple[str, Content]:
    """In words and as a geometry: a rig one of whose lengths is larger or smaller by a share."""
    factor = float(setting.rng.choice([1 - by, 1 + by]))
    return f"{length} x {factor}", changed(setting.geometry, **{length.split()[0]: factor})


def mirror_reversed(setting: Setting) -> Wrong:
    """The mirror turns the other way than its calibration says, since two wires are swapped."""
    return _of_world(setting, "mirror x -1", changed(setting.geometry, mirror=-1.0))


def wrong_edge(setting: Setting) -> Wrong:
    """Markers are taken by their falling edge, as late as a pulse is long: a point, or half of the way to the next."""

    def late(recording: Recording) -> str:
        plan = recording.plan
        apart = int(np.diff(plan.marker_points).min()) / 2 if setting.rng.random() < 0.7 else 1
        frames = apart / plan.point_rate_hz * plan.frame_rate_hz
        recording.delay_markers(round(frames * PER_FRAME))
        return f"pulses of {frames:.2f} frames"

    return _of_recording(setting, late)


def segments_mixed(setting: Setting) -> Wrong:
    """A segment of another recording of the same rig: all of it, or from some block on."""
    other = setting.with_other_scene().scan("b")

    def mixed(recording: Recording) -> str:
        second = Recording(other)
        starts = [each for each in recording.blocks() if each < len(second.records)]
        if len(starts) < 3 or setting.rng.random() < 0.3:
            recording.take(second, slice(None))
            return "the whole segment"
        first = int(setting.rng.choice(starts[1:-1]))
        recording.take(second, slice(first, None))
        return f"from frame {first} on"

    return _of_recording(setting, mixed, sealed=False)


def maps_mixed(setting: Setting) -> Wrong:
    """Frames of two maps, of which something moved in between: by turns frame by frame, column by column or halves."""
    other = setting.with_other_scene().scan("b")

    def mixed(recording: Recording) -> str:
        second = Recording(other)
        (frames,) = recording.maps()[:1]
        number = np.arange(len(frames))
        column = number // recording.plan.exposures
        how = str(setting.rng.choice(["frames", "columns", "halves"]))
        pick = {"frames": number % 2, "columns": column % 2, "halves": column >= recording.plan.columns // 2}[how]
        recording.take(second, frames[pick.astype(bool)])
        return f"{how} by turns"

    return _of_recording(setting, mixed)


def gain_halved(setting: Setting) -> Wrong:
    """The laser has half its power from the middle of a sweep on."""
    return _spliced(setting, "half the power", setting.scan("b", power_mw=25.0))


def fog_comes(setting: Setting) -> Wrong:
    """Fog comes in, or lifts, during a sweep."""
    made = setting.scene.startswith("made")
    others = ("made", "made in fog") if made else ("street-clear", "street-light-fog", "street-dense-fog", "street")
    scene = str(setting.rng.choice([other for other in others if other != setting.scene]))
    return _spliced(setting, scene, replace(setting, scene=scene).scan("b"))


def _knocked(setting: Setting) -> tuple[str, Content]:
    by = float(setting.rng.choice([-1, 1]) * setting.rng.uniform(1, 5))
    return f"principal point {by:+.1f} px", changed(setting.geometry, right_px=by)


def lens_knocked_before(setting: Setting) -> Wrong:
    """The principal point has moved since the calibration."""
    return _of_world(setting, *_knocked(setting))


def lens_knocked_between(setting: Setting) -> Wrong:
    """The principal point moves between two maps, or within one of them."""
    what, true = _knocked(setting)
    share = 0.0 if setting.rng.random() < 0.5 else None
    return _spliced(setting, what, setting.scan("b", true), share=share)


def upside_down(setting: Setting) -> Wrong:
    """The picture upside down."""
    return _flipped(setting, 0)


def mirrored(setting: Setting) -> Wrong:
    """The picture mirrored, left for right."""
    return _flipped(setting, 1)


def _flipped(setting: Setting, axis: int) -> Wrong:
    def in_place(recording: Recording) -> str:
        recording.put(np.flip(recording.bits(), 1 + axis))
        return "flipped"

    return _of_recording(setting, in_place)


def other_exposures(setting: Setting) -> Wrong:
    """Two maps were taken with twice or half the exposures that the plan says, and with as many columns."""

    def planned(cube: Cube) -> tuple[str, Cube]:
        factor = 2 if setting.exposures % 2 or setting.rng.random() < 0.5 else 0
        exposures = cube.exposures * 2 if factor else cube.exposures // 2
        return f"K = {cube.exposures}, planned {exposures}", replace(cube, exposures=exposures)

    return _of_cube(replace(setting, maps=2), planned)


def blank_band(setting: Setting) -> Wrong:
    """A cable hides 5 to 30 % of the sensor's width, or its read-out gives none of these columns."""

    def dark(recording: Recording) -> str:
        bits, share = recording.bits(), setting.rng.uniform(0.05, 0.3)
        first = int(setting.rng.uniform(0, 1 - share) * recording.width)
        end = first + int(share * recording.width)
        bits[:, :, first:end] = False
        recording.put(bits)
        return f"pixels {first} to {end - 1} of {recording.width}"

    return _of_recording(setting, dark)


def scanner_stuck(setting: Setting) -> Wrong:
    """The mirror stands still from the first column, or from some column on, while all its signals go on."""

    def stands(recording: Recording) -> str:
        exposures, share = (
            recording.plan.exposures,
            0.0 if setting.rng.random() < 0.5 else setting.rng.uniform(0.1, 0.9),
        )
        for frames in recording.maps():
            # Light of the column at which it stands, drawn anew from the frames around it for each later one.
            at = max(int(share * len(frames)), 2 * exposures)
            kept = recording.pixels[frames[at - 2 * exposures : at]].copy()
            there = frames[at:]
            recording.pixels[there] = kept[setting.rng.integers(len(kept), size=len(there))]
            if share == 0.0:
                recording.pixels[frames[:at]] = kept[setting.rng.integers(len(kept), size=at)]
        return f"from {share:.2f} of the sweep on"

    return _of_recording(setting, stands)


def blinded(setting: Setting) -> Wrong:
    """Light from outside for 10 to 60 % of a sweep: 5 to 99 % of all pixels fire."""

    def bright(recording: Recording) -> str:
        rng = setting.rng
        rate, share = float(rng.choice([0.05, 0.2, 0.5, 0.9, 0.99])), rng.uniform(0.1, 0.6)
        frames = recording.maps()[0]
        first = int(rng.uniform(0, 1 - share) * len(frames))
        there = frames[first : first + int(share * len(frames))]
        bits = recording.bits(there)
        recording.put(bits | (rng.random(bits.shape) < rate), there)
        return f"{rate:.0%} of pixels in {share:.0%} of the sweep"

    return _of_recording(setting, bright)


def gate_closed(setting: Setting) -> Wrong:
    """The interlock opens for part of the sweep, so that there is no light, and the gate's level says so or not."""

    def dark(recording: Recording) -> str:
        frames, share = recording.maps()[0], setting.rng.uniform(0.1, 0.6)
        first = int(setting.rng.uniform(0, 1 - share) * len(frames))
        there = frames[first : first + int(share * len(frames))]
        unlit = np.flatnonzero((recording.records["marks"] & GATE_HIGH) == 0)
        recording.pixels[there] = recording.pixels[setting.rng.choice(unlit, len(there))]
        said = bool(setting.rng.random() < 0.5)
        if said:
            recording.records["marks"][there] &= ~np.uint32(GATE_HIGH)
        return f"{share:.0%} of the sweep dark, {'marked' if said else 'not marked'}"

    return _of_recording(setting, dark)


@dataclass(frozen=True)
class Case:
    """A wrong input's maker, and what it needs of a setting. maps: to scan. fewest: exposures per column. pixels:
    whether a map of the sensor's pixels may matter."""

    make: Make
    maps: int = 1
    fewest: int = 1
    pixels: bool = False


CASES: Mapping[str, Case] = {
    "none": Case(none, pixels=True),
    "bit order swapped": Case(bit_order, pixels=True),
    "exposures and columns swapped": Case(exposures_for_columns, fewest=2),
    "columns reversed": Case(columns_reversed),
    "half a column late": Case(half_a_column_late, fewest=2),
    "another rig's calibration": Case(other_calibration),
    "baseline 3 % off": Case(baseline_off),
    "focal length 2 % off": Case(focal_length_off),
    "baseline 3 % off before the run": Case(baseline_off_before),
    "focal length 2 % off before the run": Case(focal_length_off_before),
    "mirror the other way": Case(mirror_reversed),
    "markers of the wrong edge": Case(wrong_edge),
    "two recordings' segments mixed": Case(segments_mixed),
    "two maps' frames mixed": Case(maps_mixed, fewest=2),
    "laser halved in mid-sweep": Case(gain_halved),
    "fog comes in mid-sweep": Case(fog_comes),
    "lens knocked before the run": Case(lens_knocked_before),
    "lens knocked in mid-run": Case(lens_knocked_between, maps=3),
    "picture upside down": Case(upside_down, pixels=True),
    "picture mirrored": Case(mirrored, pixels=True),
    "another K than planned": Case(other_exposures),
    "blank column band": Case(blank_band),
    "scanner stuck": Case(scanner_stuck),
    "SPAD blinded for a while": Case(blinded),
    "laser dark for a while": Case(gate_closed),
}
