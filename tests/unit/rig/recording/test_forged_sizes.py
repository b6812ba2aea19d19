"""Files whose numbers tell of more than they hold: none of them decides how much memory or time is taken."""

import io
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from calibration.files.npy_files import load_array, load_arrays
from drivers.errors import DeviceError
from drivers.frames import FrameBlock
from drivers.recorded import RunRecording
from drivers.recorded.segments import FrameTable, table_bytes
from rig.api import export_run, reconstruct
from rig.count.bind import FrameBinder
from rig.errors import RigError, UsageError
from rig.recording.inputs import PLAN_FILE, read_plan, write_inputs
from rig.recording.open import info
from rig.recording.repair import repair
from rig.recording.replay import recorded_sweeps
from rig.recording.verify import verify
from rig.run_folder.manifest import read_manifest
from tests.unit.rig.count.streams import plan_of, rig_model, scan
from tests.unit.rig.recording.forging import forge_index
from tests.unit.rig.recording.recorded import record, run_blocks

pytestmark = pytest.mark.slow

MOST_BYTES = 100_000_000
"""Of what is done with a recording of a megabyte; what forged numbers ask for is gigabytes."""


@contextmanager
def little_memory() -> Iterator[None]:
    """The block takes no more than `MOST_BYTES`; it may end in an error of ours."""
    tracemalloc.start()
    try:
        with suppress(RigError, DeviceError):
            yield
        assert tracemalloc.get_traced_memory()[1] < MOST_BYTES
    finally:
        tracemalloc.stop()


def forged(folder: Path, change: Callable[[int, FrameBlock], dict[str, Any]], **manifest: Any) -> Path:
    """A sound recording but for what `change` says of its blocks' headers; all checksums are right."""
    blocks = [replace(block, header=replace(block.header, **change(i, block))) for i, block in enumerate(run_blocks())]
    write_inputs(record(folder, [blocks], **manifest), plan_of(scan()), rig_model())
    return folder


@pytest.fixture(scope="module", autouse=True)
def _compiled(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Kernels are there before memory is traced, under which they compile many times slower."""
    reconstruct(forged(tmp_path_factory.mktemp("sound") / "run", lambda i, _: {}))


@pytest.mark.parametrize("command", [info, verify, repair])
def test_a_run_number_of_the_index_takes_no_memory(tmp_path: Path, command: Callable[[Path], object]) -> None:
    forge_index(record(tmp_path, [run_blocks()]), 1, "run_id", 2**31 - 1)
    with little_memory():
        command(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        {"sweep": 2**32 - 1}, {"first_frame": 2**62}, {"t0_ticks": 2**62},
        {"sensor_width": 0xFFFF, "sensor_height": 0xFFFF},
    ],
)  # fmt: skip
def test_a_header_takes_no_memory_and_no_time(tmp_path: Path, change: dict[str, int]) -> None:
    last = len(run_blocks()) - 1
    folder = forged(tmp_path / "run", lambda i, _: change if i == last else {}, verdict="aborted", recording={})
    for command in (info, verify, reconstruct):
        with little_memory():
            command(folder)
    with little_memory():
        export_run(folder, "png", view="frames")


def test_no_more_sweeps_are_made_than_there_are_frames(tmp_path: Path) -> None:
    folder = forged(tmp_path / "run", lambda i, _: {"sweep": 2**32 - 1}, recording={})
    recording = RunRecording(folder)
    assert [start.sweeps for start in recorded_sweeps(recording, plan_of(scan()), {})] == [recording.frames]
    folder = forged(tmp_path / "other", lambda i, _: {}, recording={"starts": [{"sweeps": 10**12, "segment": 0}]})
    starts = recorded_sweeps(RunRecording(folder), plan_of(scan()), read_manifest(folder))
    assert sum(start.sweeps for start in starts) <= recording.frames


def test_sweeps_that_nobody_wants_are_not_bound() -> None:
    blocks: Sequence[FrameBlock] = run_blocks()
    binder = FrameBinder(plan_of(scan()), end_sweep=5)
    closed = []
    for block in blocks[:4]:
        closed += binder.bind(block)[1]
    late = replace(blocks[4], header=replace(blocks[4].header, sweep=2**32 - 1, t0_ticks=2**62))
    late.records["sweep"] = 0xFFFF
    closed += binder.bind(late)[1]
    assert [clock.sweep for clock in closed] == list(range(len(closed)))
    assert len(closed) == 5


@pytest.mark.parametrize(
    ("what", "value"),
    [
        *((name, 10**9) for name in ("columns", "exposures", "rows", "width", "window", "sweep_points")),
        ("frame_rate_hz", "1e999999999"),
        ("point_rate_hz", "-1"),
        ("commands", {"dtype": "U1000000", "values": ["a"] * 10}),
        ("x0", {"dtype": "int32", "values": [2**30] * 10}),
    ],
)
def test_numbers_of_a_plan_fit_its_arrays(tmp_path: Path, what: str, value: object) -> None:
    write_inputs(tmp_path, plan_of(scan()), None)
    file = tmp_path / PLAN_FILE
    content = yaml.safe_load(file.read_text())
    assert what in content["plan"]
    content["plan"][what] = value
    file.write_text(yaml.safe_dump(content))
    with little_memory(), pytest.raises(UsageError, match=what):
        read_plan(tmp_path)


def test_a_plan_of_another_sensor_makes_no_counters(tmp_path: Path) -> None:
    folder = forged(tmp_path / "run", lambda i, _: {})
    content = yaml.safe_load((folder / PLAN_FILE).read_text())
    content["plan"]["rows"] = 0xFFFF
    (folder / PLAN_FILE).write_text(yaml.safe_dump(content))
    with little_memory(), pytest.raises(RigError, match=r"plan\.yaml is for"):
        reconstruct(folder)


def npy(shape: tuple[int, ...], dtype: str, data: bytes = b"", version: str = "1_0") -> bytes:
    """A .npy file whose header says what it likes."""
    stream = io.BytesIO()
    write = getattr(np.lib.format, f"write_array_header_{version}")
    write(stream, {"descr": dtype, "fortran_order": False, "shape": shape})
    return stream.getvalue() + data


def npz(member: bytes, method: int = zipfile.ZIP_STORED) -> bytes:
    """An archive with one array."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        archive.writestr("depth_m.npy", member)
    return stream.getvalue()


LARGE = (2**20, 2**14)


@pytest.mark.parametrize(
    "content",
    [
        npy(LARGE, "<f4"),
        npy(LARGE, "<f4", version="2_0"),
        npy((2**40, 2**40), "<f4"),
        npy((1,), "<U100000000", b"\0" * 4),
        npy((2**62,), "|V0"),
        b"\x93NUMPY\x02\x00\xff\xff\xff\xff",
        npz(npy(LARGE, "<f4")),
        npz(npy(LARGE, "<f4"), zipfile.ZIP_DEFLATED),
    ],
)
def test_headers_of_arrays_fit_their_files(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "file"
    file.write_bytes(content)
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"says that it holds|header of"):
        load_array(file)
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()


def test_an_archive_does_not_hold_more_than_its_bytes_can_stand_for(tmp_path: Path) -> None:
    raw = bytearray(npz(npy((4,), "<f4", b"\0" * 16)))
    directory = raw.rindex(b"PK\x01\x02")
    raw[directory + 24 : directory + 28] = (2**27).to_bytes(4, "little")  # the size of its member, unpacked
    (tmp_path / "file").write_bytes(raw)
    with pytest.raises(ValueError, match="which it cannot"):
        load_arrays(tmp_path / "file")


def test_a_table_of_compressed_blocks_holds_no_more_than_they_can() -> None:
    packed = np.frombuffer(bytes(100) + table_bytes([(100, 1 << 31)]), np.uint8)
    assert FrameTable.read(packed).size == 0


def archive(*, names: Sequence[str] = ("depth_m.npy",), zeros: int = 0) -> bytes:
    """An archive whose members are compressed zeros."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as made:
        for name in names:
            made.writestr(name, npy((zeros,), "|u1", bytes(zeros)))
    return stream.getvalue()


def shared(raw: bytes, copies: int) -> bytes:
    """An archive whose directory names its one member many times, each time as another array of the same bytes."""
    directory, end = raw.rindex(b"PK\x01\x02"), raw.rindex(b"PK\x05\x06")
    entry = raw[directory:end]
    entries = b"".join(entry.replace(b"depth_m", b"%07d" % i) for i in range(copies))
    counts = copies.to_bytes(2, "little") * 2 + len(entries).to_bytes(4, "little")
    return raw[:directory] + entries + raw[end : end + 8] + counts + raw[end + 16 :]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (shared(archive(zeros=2**20), 200), "its 200 arrays overlap"),
        (archive(zeros=2**28 + 2**20), "its arrays take 257 MiB, it has"),
        (archive(names=("depth_m",), zeros=10), "depth_m in it is no .npy file"),
    ],
    ids=["overlap", "zeros", "name"],
)
def test_an_archive_is_no_bomb(tmp_path: Path, content: bytes, said: str) -> None:
    (tmp_path / "file").write_bytes(content)
    tracemalloc.start()
    with pytest.raises(ValueError, match=said):
        load_arrays(tmp_path / "file")
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()
