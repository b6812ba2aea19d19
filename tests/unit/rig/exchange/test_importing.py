"""Imports: every pixel of a foreign file is where it belongs, and what is no such file is refused."""

import json
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.frames import BlockFlag, FrameBlock
from drivers.recorded import INDEX_FILE, RunRecording
from rig.api import import_frames, repair, verify
from rig.errors import UsageError
from rig.exchange import raw_files
from rig.exchange.importing import ImportResult
from tests.unit.rig.exchange.foreign_files import (
    Frames,
    pi_packed,
    pi_sparse,
    some_frames,
    swissspad2_full,
    swissspad2_half,
)
from tests.unit.rig.recording.recorded import flip

NUMBERS = st.integers(-5, 2**70) | st.floats()
JSON = st.recursive(st.none() | NUMBERS | st.text(max_size=3), lambda inner: st.lists(inner, max_size=3), max_leaves=6)
CLOCKS = st.fixed_dictionaries({"tick_hz": st.lists(NUMBERS, min_size=2, max_size=2), "frame_period_ticks": NUMBERS})
RANGES = st.lists(st.tuples(st.integers(0, 2), st.integers(0, 2**70), st.integers(-1, 4)), max_size=3)

DEFECTS = Path(__file__).parents[5] / "shared" / "sensor-data" / "defect_mask_254x496.npy"


def blocks_of(folder: Path) -> list[FrameBlock]:
    recording = RunRecording(folder)
    assert recording.problems == []
    return [block for run in recording.runs for block in recording.blocks(run)]


def frames_of(folder: Path) -> Frames:
    return np.concatenate([np.unpackbits(b.bits, axis=2, count=b.header.width) for b in blocks_of(folder)]).astype(bool)


def import_cube(folder: Path, array: np.ndarray, beside: object = None, **options: object) -> ImportResult:
    """Import a cube as numpy writes it; beside: what its sidecar says."""
    np.save(folder / "frames.npy", array)
    if beside is not None:
        (folder / "frames.json").write_text(json.dumps(beside))
    return import_frames("photoncube", [folder / "frames.npy"], folder / "run", **options)  # type: ignore[arg-type]


def test_pi_imaging_frames_are_turned_upright_in_a_recording_that_verifies(tmp_path: Path) -> None:
    frames = some_frames(3, 512, 512)
    (tmp_path / "RAW00000.bin").write_bytes(pi_packed(frames))
    result = import_frames("pi-imaging", [tmp_path / "RAW00000.bin"], tmp_path / "run")
    assert (result.frames, result.width, result.height) == (3, 512, 512)
    assert np.array_equal(frames_of(tmp_path / "run"), np.rot90(frames, axes=(1, 2)))
    assert verify(tmp_path / "run").exit_code == 0


def test_done_behind_the_pixels_is_no_pixel_and_done_in_them_is(tmp_path: Path) -> None:
    raw = pi_packed(some_frames(2, 512, 512))[:-4] + b"DONE"
    (tmp_path / "a.bin").write_bytes(raw)
    (tmp_path / "b.bin").write_bytes(raw + b"DONE")
    import_frames("pi-imaging", [tmp_path / "a.bin", tmp_path / "b.bin"], tmp_path / "run", turn_deg=0)
    assert np.packbits(frames_of(tmp_path / "run"), axis=2).tobytes() == raw + raw


@pytest.mark.parametrize(("rows", "ending"), [(512, b""), (1024, b"DONE")])
def test_sparse_lists_are_seen_from_the_file(tmp_path: Path, rows: int, ending: bytes) -> None:
    frames = some_frames(70, rows, 512, seed=3) & some_frames(70, rows, 512, seed=4)
    frames[[0, 65]] = False
    (tmp_path / "sparse.bin").write_bytes(pi_sparse(frames) + ending)
    import_frames("pi-imaging", [tmp_path / "sparse.bin"], tmp_path / "run", turn_deg=0, rows=rows)
    assert np.array_equal(frames_of(tmp_path / "run"), frames)


def test_a_file_that_could_be_either_is_asked_about(tmp_path: Path) -> None:
    dark = np.zeros((1, 512, 512), bool)
    dark[0, 511, 512 - 32 + 21] = True  # the last four bytes read 262144, little-endian
    (tmp_path / "dark.bin").write_bytes(pi_packed(dark))
    with pytest.raises(UsageError, match="`form`"):
        import_frames("pi-imaging", [tmp_path / "dark.bin"], tmp_path / "run")
    import_frames("pi-imaging", [tmp_path / "dark.bin"], tmp_path / "run", form="packed", turn_deg=0)
    assert np.array_equal(frames_of(tmp_path / "run"), dark)


@pytest.mark.parametrize(("form", "rows", "raw"), [(None, 256, swissspad2_half), ("full", 512, swissspad2_full)])
def test_swissspad2_pixels_are_where_the_camera_saw_them(tmp_path: Path, form, rows, raw) -> None:
    frames = some_frames(5, rows, 512)
    (tmp_path / "RAW00000.bin").write_bytes(raw(frames))
    import_frames("swissspad2", [tmp_path], tmp_path / "run", form=form)
    assert np.array_equal(frames_of(tmp_path / "run"), frames)


@pytest.mark.parametrize("full", [False, True])
def test_swissspad2_as_photoncube_converts_it(tmp_path: Path, full: bool) -> None:
    tool = pytest.importorskip("photoncube", reason="pip install photoncube")
    per_file = 256 if full else 512
    raw = np.random.default_rng(7).integers(0, 256, (2, per_file * (32768 if full else 16384)), np.uint8)
    camera = tmp_path / "camera"
    camera.mkdir()
    for number, content in zip((9, 10), raw, strict=True):  # by number, not by letter
        (camera / f"RAW{number}.bin").write_bytes(content.tobytes())
    tool.PhotonCube.convert_to_npy(str(camera), str(tmp_path / "cube.npy"), is_full_array=full)
    import_frames("swissspad2", [camera], tmp_path / "run", form="full" if full else "half")
    got = np.concatenate([block.bits for block in blocks_of(tmp_path / "run")])
    assert np.array_equal(got, np.load(tmp_path / "cube.npy"))


def test_full_frames_read_as_halves_are_noticed() -> None:
    scene = np.random.default_rng(1).random((512, 512)) * 0.3
    if DEFECTS.exists():  # a real sensor's pattern of hot pixels
        scene[:254, :496][np.load(DEFECTS)] = 0.9
    frames = np.random.default_rng(2).random((24, 512, 512)) < scene
    raw = np.frombuffer(swissspad2_full(frames), np.uint8)
    assert raw_files._alternates(raw)
    halves = np.frombuffer(swissspad2_half(frames[:, :256]), np.uint8)
    assert not raw_files._alternates(halves)


def test_a_photon_cube_of_any_width_keeps_its_clock_and_numbers(tmp_path: Path) -> None:
    frames = some_frames(9, 3, 21)
    sidecar = {
        "format": "spadrig-frames",
        "width": 21,
        "clock": {"tick_hz": [97_700_000, 1], "frame_period_ticks": 1000},
        "ranges": [[1, 0, 4], [1, 6, 5]],
    }
    dirty = np.packbits(frames, axis=2) | np.array([0, 0, 7], np.uint8)  # no pixels: cleared
    assert import_cube(tmp_path, dirty, sidecar).gaps == ((4, 5),)
    first, second = blocks_of(tmp_path / "run")
    assert (first.header.first_frame, second.header.first_frame, second.header.lost_before) == (0, 6, 2)
    assert second.header.flags == BlockFlag.LAST | BlockFlag.LOST_BEFORE
    assert first.header.tick_hz / first.header.frame_period_ticks == 97_700
    assert np.array_equal(frames_of(tmp_path / "run"), frames)
    assert second.start_ticks[0] == 6 * first.header.frame_period_ticks


def test_the_end_of_an_import_that_does_not_begin_at_frame_0_is_missed_without_its_index(tmp_path: Path) -> None:
    sidecar = {"format": "spadrig-frames", "width": 16, "ranges": [[1, 5, 4], [1, 11, 5]]}
    import_cube(tmp_path, np.packbits(some_frames(9, 2, 16), axis=2), sidecar)
    run = tmp_path / "run"
    flip(run / "frames-000000.spb", 4096 + 300)
    (run / INDEX_FILE).unlink()
    assert repair(run).after.gaps == [(0, 9, 15)]


@settings(max_examples=50, deadline=None)
@given(content=st.dictionaries(st.sampled_from(["width", "clock", "ranges"]), JSON | CLOCKS | RANGES))
def test_whatever_stands_beside_a_cube_its_pixels_are_taken_or_refused(
    tmp_path_factory: pytest.TempPathFactory, content: dict[str, object]
) -> None:
    folder = tmp_path_factory.mktemp("beside")
    frames = some_frames(3, 2, 16)
    try:
        import_cube(folder, np.packbits(frames, axis=2), {"format": "spadrig-frames", "width": 16, **content})
    except UsageError:
        return
    width = content.get("width", 16)
    assert np.array_equal(frames_of(folder / "run"), frames[:, :, :width])


def test_a_photon_cube_with_one_channel_is_that_channel_at_a_rate_that_blocks_can_say(tmp_path: Path) -> None:
    frames = some_frames(2, 4, 16)
    for rate in (Fraction(0), Fraction(1, 10**12), Fraction(2**32)):
        with pytest.raises(UsageError, match="frame rate"):
            import_cube(tmp_path, np.packbits(frames, axis=2), frame_rate=rate)
    import_cube(tmp_path, np.packbits(frames, axis=2)[..., None], frame_rate=Fraction(100_000, 3))
    assert np.array_equal(frames_of(tmp_path / "run"), frames)
    header = blocks_of(tmp_path / "run")[0].header
    assert header.tick_hz / header.frame_period_ticks == Fraction(100_000, 3)


@pytest.mark.parametrize(
    ("array", "why"),
    [
        (np.zeros((2, 4, 2), np.float32), r"float32 .* make it with numpy\.packbits\(frames != 0, axis=2\)"),
        (np.zeros((2, 4, 2), np.int64), r"int64 .* make it with numpy\.packbits\(frames, axis=2\)"),
        (np.zeros((4, 2), np.uint8), "shape"),
        (np.zeros((0, 4, 2), np.uint8), "shape"),
        (np.zeros((2, 4, 2, 3), np.uint8), "3 channels"),
    ],
)
def test_what_is_no_photon_cube_is_refused(tmp_path: Path, array: np.ndarray, why: str) -> None:
    with pytest.raises(UsageError, match=why):
        import_cube(tmp_path, array)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("transforms", "why"),
    [
        ({"bitpack": True, "bitpack_dim": 1, "w": 16}, "axis 1"),
        ({"bitpack": False, "w": 2}, "not packed"),
        ({"bitpack": True, "bitpack_dim": 2, "w": 40}, "width of 40"),
    ],
)
def test_visionsim_says_how_a_cube_is_packed(tmp_path: Path, transforms: dict[str, object], why: str) -> None:
    (tmp_path / "transforms.json").write_text(json.dumps({**transforms, "file_path": "frames.npy"}))
    with pytest.raises(UsageError, match=why):
        import_cube(tmp_path, np.zeros((2, 4, 2), np.uint8))


@pytest.mark.parametrize("kind", ["pi-imaging", "swissspad2"])
def test_every_file_that_was_cut_off_is_named(tmp_path: Path, kind: str) -> None:
    for name in ("a.bin", "b.bin"):
        (tmp_path / name).write_bytes(bytes(40000))
    (tmp_path / "c.bin").write_bytes(b"")
    with pytest.raises(UsageError) as refused:
        import_frames(kind, [tmp_path], tmp_path / "run")
    assert len(refused.value.problems) == 3
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("kind", "options", "why"),
    [
        ("tiff", {}, "choose one of pi-imaging"),
        ("photoncube", {"form": "half"}, "leave `form` out"),
        ("swissspad2", {"form": "sparse"}, "half or full"),
        ("swissspad2", {"turn_deg": 45}, "45 degrees"),
        ("swissspad2", {"rows": 512}, "leave `rows` out"),
        ("pi-imaging", {"rows": 600}, "1024"),
        ("pi-imaging", {"frame_rate": "100"}, "no unit"),
    ],
)
def test_options_that_cannot_be_are_refused(tmp_path: Path, kind: str, options: dict[str, object], why: str) -> None:
    with pytest.raises(UsageError, match=why):
        import_frames(kind, [tmp_path], tmp_path / "run", **options)  # type: ignore[arg-type]


def test_a_cube_that_looks_unpacked_is_refused_until_it_is_said_to_be_packed(tmp_path: Path) -> None:
    frames = some_frames(40, 6, 16)
    with pytest.raises(UsageError, match=r"0 and 1 only.*numpy\.packbits\(frames, axis=2\).*`form='packed'`"):
        import_cube(tmp_path, frames.astype(np.uint8))
    assert not (tmp_path / "run").exists()
    result = import_cube(tmp_path, frames.astype(np.uint8), form="packed")
    assert (result.width, result.frame_rate_hz) == (128, None)
    assert blocks_of(tmp_path / "run")[0].header.frame_period_ticks == 0  # nobody said how fast they came
    assert np.array_equal(frames_of(tmp_path / "run"), np.unpackbits(frames.astype(np.uint8), axis=2).astype(bool))
