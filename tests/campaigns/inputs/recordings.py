"""Recordings: blocks, streams of them, segments, index, manifest, plan, learned state and recorded control traffic."""

import json
import shutil
import struct
import zlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import ProtocolError
from drivers.frames import FrameBlock
from drivers.recorded.contents import INDEX_FILE, RECORD_BYTES, segment_name
from drivers.recorded.segments import PackedSegment, PlainSegment, table_bytes
from drivers.replay.spad import recorded_info
from drivers.spb1 import Damage, parse_block, walk_blocks
from drivers.spb1.control import Ack, read_acks
from drivers.spb1.layout import CRC, HEADER, HEADER_BYTES, MAGIC, TRAILER, TRAILER_BYTES, seal_control
from drivers.spb1.reader import read_control, read_header, walk_placed
from drivers.transports.tap import CONTROL_FILE, read_taps
from rig.api.as_before import repeat
from rig.recording.inputs import LEARNED_FILE, PLAN_FILE, read_plan, write_inputs
from rig.recording.open import info, map_spans, open_recording
from rig.recording.verify import Integrity, verify
from rig.report.run_facts import read_run
from rig.requests import RunsRequest
from rig.run_folder.folder import read_learned
from rig.run_folder.manifest import MANIFEST, manifest_crc32, read_manifest, require_playable
from rig.run_folder.runs import SUMMARY, list_runs
from rig.run_folder.time_of_day import read_anchors
from tests.campaigns.inputs.changes import JSON, NPZ, YAML, Changes
from tests.campaigns.inputs.files import in_file, npz, scratch
from tests.campaigns.inputs.fuzz import OURS, Target
from tests.unit.rig.count.streams import plan_of, scan
from tests.unit.rig.recording.recorded import record, run_blocks

MANIFEST_CONTENT: dict[str, Any] = {
    "command": "scan", "seed": 1, "maps": 1, "note": "a note", "tags": ["fog", "lab"], "versions": {"spadrig": "1.0"},
    "config": {"name": "small", "world": {"kind": "simulated", "scene": "street"}, "spad": {"kind": "simulated"},
               "scanner": {"kind": "simulated"}, "laser": {"kind": "simulated"}, "sync": {"kind": "simulated"},
               "scan": {"exposures": 4, "columns": 20}, "estimate": {"estimator": "argmax", "min_confidence": 0.5},
               "calibration": "calibration.yaml"},
    "calibration": {"id": "0123456789abcdef", "accepted": [["a", "b"]]},
    "rig": {"kinds": {"spad": "simulated"}, "serials": {"spad": "0"}, "taken": "2026-11-29T10:00:00+00:00"},
    "devices": {"spad": {"info": {"model": "m", "serial": "0", "width": 64, "height": 4, "rotation_deg": 0,
                                  "max_frame_rate_hz": "100000", "burst": None, "stream": {"bytes_per_s": 1e9},
                                  "roi_step_px": 64, "markers": True, "trigger_modes": ["free"]}}},
    "inputs": {PLAN_FILE: 1}, "cut": None, "missing": [[0, 1, 2]], "repaired": ["frames.idx"],
    "sweeps": [{"first_frame": 0, "end_frame": 80, "clock_error": 1e-5, "residual_columns": 0.01,
                "utc": ["2026-11-29T10:00:00Z", "2026-11-29T10:00:01Z"], "utc_uncertainty_s": 0.1,
                "fog": {"extinction_per_m": 0.05}}],
    "request": {"seed": 1, "maps": 1, "record": True, "save": "all"},
    "time": {"scale": "host", "host": {"utc": "2026-11-29T10:00:00Z", "step_s": 0.0},
             "starts": [{"run_id": 1, "frame": 0, "tick": 0, "tick_hz": 1e8, "period_s": 1e-5,
                         "utc": "2026-11-29T10:00:00Z", "uncertainty_s": 0.1, "rate_error": 0.0,
                         "rate_uncertainty": 1e-4, "pairs": 5}]},
    "on_request": {"parts": [{"folder": "part-000"}]},
}  # fmt: skip
"""Every key that a command reads."""
SUMMARY_CONTENT: dict[str, Any] = {
    "maps": 1, "map_rate_hz": 18.2, "columns": 20, "exposures": 4, "estimator": "argmax", "filter": "none",
    "frames": {"expected": 96, "received": 96, "lost": 0, "crc_errors": 0, "lit": 80}, "sensor_time_s": 0.05,
    "compute_time_s": 0.03, "realtime_factor": 1.8, "valid_fraction": 0.97, "verdict": "complete",
    "fog": {"extinction_per_m": 0.05, "visibility_m": 78.2, "ambient_per_exposure": 0.01},
    "truth": {"stripe_error_px": {"mean_abs": 0.1}, "depth_error_m": {"mean_abs": 0.01}},
}  # fmt: skip


@cache
def recording() -> Path:
    """A recording of two starts with everything beside its frames."""
    folder = record(scratch() / "seed", [run_blocks(maps=1), run_blocks(run_id=2, maps=1)])
    write_inputs(folder, plan_of(scan()), None)
    return folder


def _files(name: str) -> Callable[[], list[bytes]]:
    return lambda: [(recording() / name).read_bytes()]


def _copy(name: str) -> Path:
    """A copy of the recording to write damaged files into."""
    folder = scratch() / name / "run"
    if not folder.exists():
        shutil.copytree(recording(), folder)
    return folder


# Blocks


def _blocks() -> list[bytes]:
    whole = (recording() / segment_name(0)).read_bytes()
    control = np.zeros(1024, np.uint8)
    seal_control(control, 0x7E, 1, Ack(1, 2, 0, 3).packed() * 2)
    return [whole[:4096], whole[4096:8192], control.tobytes()]


def sign_blocks(data: bytes) -> bytes:
    """Make the checksums of headers, payloads and trailers right, wherever a block begins on a multiple of 1024."""
    found = bytearray(data)
    for at in range(0, len(found), 1024):
        if found[at : at + 4] != MAGIC or at + HEADER_BYTES > len(found):
            continue
        _sign(found, at, HEADER_BYTES)
        fields = HEADER.unpack_from(found, at)
        begin, payload = at + fields[2], fields[22]
        end = begin + payload
        if end + TRAILER_BYTES <= len(found):
            trailer = list(TRAILER.unpack_from(found, end))
            trailer[4] = zlib.crc32(found[begin:end])
            TRAILER.pack_into(found, end, *trailer)
            _sign(found, end, TRAILER_BYTES)
    return bytes(found)


def _sign(found: bytearray, at: int, size: int) -> None:
    CRC.pack_into(found, at + size - CRC.size, zlib.crc32(found[at : at + size - CRC.size]))


def _parse_block(data: bytes) -> None:
    block = parse_block(np.frombuffer(data, np.uint8), check_payload=True)
    assert len(block.records) == len(block.bits) == len(block.frame_numbers) == len(block.start_ticks)


def _walk(data: bytes) -> str:
    buffer = np.frombuffer(data, np.uint8)
    at, said = 0, []
    for item in walk_placed(buffer, None, check_payload=True):
        assert item.offset >= at, "pieces in order"
        at = item.offset + item.length if isinstance(item, Damage) else item.end
        said.append(item.reason if isinstance(item, Damage) else "")
    list(walk_blocks(buffer, 4096, check_payload=False))
    return " ".join(said)


def _control(data: bytes) -> None:
    buffer = np.frombuffer(data, np.uint8)
    fields = read_header(buffer)
    read_acks(read_control(buffer, fields))


# Segments and index


def _segment(file: Path) -> str:
    segment = PlainSegment(file, 0)
    said = [getattr(item, "reason", "") for item in segment.walk(0, segment.size, check_payload=True)]
    segment.release()
    return " ".join(said)


def _packed_seeds() -> list[bytes]:
    import zstandard

    whole = (recording() / segment_name(0)).read_bytes()
    packer = zstandard.ZstdCompressor(level=3, write_checksum=True)
    frames = [packer.compress(whole[at : at + 4096]) for at in range(0, 3 * 4096, 4096)]
    table = table_bytes([(len(frame), 4096) for frame in frames])
    return [b"".join(frames) + table, frames[0] + table_bytes([(len(frames[0]), 4096)]), b"".join(frames)]


def _packed(file: Path) -> str:
    segment = PackedSegment(file, 0)
    said = [getattr(item, "reason", "") for item in segment.walk(0, segment.size, check_payload=True)]
    segment.at(0, 96)
    segment.release()
    return " ".join(said)


def _sign_index(data: bytes) -> bytes:
    found = bytearray(data)
    for at in range(0, len(found) - RECORD_BYTES + 1, RECORD_BYTES):
        _sign(found, at, RECORD_BYTES)
    return bytes(found)


def _index(data: bytes) -> str:
    folder = _copy("index")
    (folder / INDEX_FILE).write_bytes(data)
    opened = open_recording(folder)
    for run in opened.runs:
        frames = [block.frame_numbers for block in opened.blocks(run)]
        assert (np.diff(np.concatenate(frames)) > 0).all(), "frames in order"
    return " ".join(opened.problems)


# What a damaged recording is called

_DAMAGED = (segment_name(0), segment_name(1), INDEX_FILE, MANIFEST, PLAN_FILE)


def _verify_seeds() -> list[bytes]:
    return [struct.pack("B", number) + (recording() / name).read_bytes() for number, name in enumerate(_DAMAGED)]


def _verify(data: bytes) -> str:
    """The first byte chooses a file, the rest is its new content."""
    folder = _copy("verify")
    name = _DAMAGED[data[0] % len(_DAMAGED)] if data else MANIFEST
    whole = (recording() / name).read_bytes()
    (folder / name).write_bytes(data[1:])
    try:
        found = verify(folder)
        same = data[1:] == whole
        assert same or found.verdict is not Integrity.INTACT or _harmless(name, data[1:], whole), (
            f"{name} is damaged, but {found.verdict}"
        )
        return " ".join(found.problems)
    finally:
        (folder / name).write_bytes(whole)


def _harmless(name: str, data: bytes, whole: bytes) -> bool:
    """Whether a change has no meaning: white space in the manifest, or bytes between the blocks of a segment."""
    if name == MANIFEST:
        try:
            return bool(json.loads(data) == json.loads(whole))
        except ValueError:
            return False
    if name == PLAN_FILE:  # the manifest of this recording names no checksum of it
        return True
    return name != INDEX_FILE and _sound(data) == _sound(whole)


def _sound(data: bytes) -> list[tuple[object, ...]]:
    """All that is in the blocks of a segment, with their places; damage too."""
    return [
        (item.offset, item.length, *(() if isinstance(item, Damage) else _content(item.block)))
        for item in walk_placed(np.frombuffer(data, np.uint8), None, check_payload=True)
    ]


def _content(block: FrameBlock) -> tuple[object, ...]:
    return block.header, block.status, block.records.tobytes(), block.bits.tobytes()


# Manifest, plan, learned state


def seal(data: bytes) -> bytes:
    """A manifest with the right seal."""
    content = json.loads(data)
    return json.dumps({**content, "crc32": manifest_crc32(content)}).encode()


def _manifest_seeds() -> list[bytes]:
    plain = json.loads((recording() / MANIFEST).read_bytes())
    cut = {"frames": [[1, 0, 80]], "maps": [0, 1], "clock_ratios": [1.0]}
    contents = [{**plain, **MANIFEST_CONTENT}, {**plain, **MANIFEST_CONTENT, "cut": cut}, plain]
    return [seal(json.dumps(content).encode()) for content in contents]


def _manifest(data: bytes) -> None:
    """Whatever reads a manifest: it may only say that the recording is damaged, or ask for something else."""
    folder = _copy("manifest")
    (folder / MANIFEST).write_bytes(data)
    list_runs(folder.parent, RunsRequest())
    verify(folder)
    info(folder)
    content = read_manifest(folder)
    assert content is not None
    read_anchors(content)
    opened = open_recording(folder)
    map_spans(opened, content)
    for read in (lambda: require_playable(folder, content), lambda: repeat(folder), lambda: recorded_info(opened)):
        try:
            read()
        except Exception as error:
            if not isinstance(error, OURS):
                raise
    read_run(folder)


def _summary(data: bytes) -> None:
    folder = _copy("summary")
    (folder / SUMMARY).write_bytes(data)
    list_runs(folder.parent, RunsRequest())
    read_run(folder)


def _plan(data: bytes) -> None:
    folder = _copy("plan")
    (folder / PLAN_FILE).write_bytes(data)
    read_plan(folder)


def learned_seeds() -> list[bytes]:
    """A learned state, plain and compressed."""
    from rig.estimate.row.model import _SHAPES

    arrays: dict[str, Any] = {name: np.zeros(shape, np.float32) for name, shape in _SHAPES.items()}
    arrays |= {"row_gain": np.ones(4, np.float32), "column_gain": np.ones(20, np.float32)}
    arrays |= {"ambient": np.zeros((4, 64), np.float32)}
    arrays |= dict.fromkeys(
        ("w_lo", "per_w", "none_weight", "line_sigma_px", "extinction_per_m", "extinction_sd_per_m"), np.float64(0.5)
    )
    arrays["weight"] = arrays["weight"].astype(np.float64)
    return [npz(**arrays), npz(packed=True, **arrays)]


def _taps() -> Sequence[bytes]:
    line = b'{"t_ns": 1234, "device": "laser", "port": "serial", "dir": ">", "bytes": "3f0d"}\n'
    return [line * 3, line.replace(b">", b"<")]


TARGETS = (
    Target("spb1-block", lambda: _blocks()[:2], _parse_block, (ProtocolError,), sign_blocks),
    Target(
        "spb1-stream",
        lambda: [b"".join(_blocks()), *_blocks()],
        _walk,
        (ProtocolError,),
        sign_blocks,
        changes=Changes(most_bytes=16384),
    ),
    Target("spb1-control", lambda: _blocks()[2:], _control, (ProtocolError,), sign_blocks),
    Target(
        "segment",
        _files(segment_name(0)),
        in_file("segment/frames-000000.spb", _segment),
        mend=sign_blocks,
        changes=Changes(most_bytes=40960),
    ),
    Target("segment-zstd", _packed_seeds, in_file("packed/frames-000000.spb.zst", _packed)),
    Target("index", _files(INDEX_FILE), _index, mend=_sign_index),
    Target("verify", _verify_seeds, _verify, changes=Changes(most_bytes=40960)),
    Target("manifest", _manifest_seeds, _manifest, mend=seal, changes=Changes(tree=JSON)),
    Target("summary", lambda: [json.dumps(SUMMARY_CONTENT).encode()], _summary, changes=Changes(tree=JSON)),
    Target("plan", _files(PLAN_FILE), _plan, changes=Changes(tree=YAML, most_bytes=200_000)),
    Target(
        "learned", learned_seeds, in_file(LEARNED_FILE, read_learned), changes=Changes(tree=NPZ, most_bytes=100_000)
    ),
    Target("control-traffic", _taps, in_file(CONTROL_FILE, read_taps), changes=Changes(tree=JSON)),
)
