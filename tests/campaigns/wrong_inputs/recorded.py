"""The frames of a recorded run, read and written by the documents alone (docs/reference/spb1.md, run-folder.md).

A recording is changed in place: the sizes of its blocks stay as they are, and all its checksums are made anew. So it
looks as if it had been taken that way.
"""

import json
import zlib
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

HEADER = np.dtype(
    [
        ("magic", "S4"), ("version", "<u2"), ("header_len", "<u2"), ("flags", "<u4"), ("bits_per_px", "u1"),
        ("payload_type", "u1"), ("run_id", "<u2"), ("block_seq", "<u8"), ("first_frame", "<u8"), ("t0_ticks", "<u8"),
        ("lost_before", "<u8"), ("tick_hz", "<u4"), ("tick_hz_den", "<u4"), ("frame_period_ticks", "<u4"),
        ("exposure_ticks", "<u4"), ("sweep", "<u4"), ("n_frames", "<u2"), ("frame_step", "<u2"), ("width", "<u2"),
        ("height", "<u2"), ("sensor_width", "<u2"), ("sensor_height", "<u2"), ("payload_len", "<u4"),
        ("pixels_offset", "<u4"), ("zero", "<u4"), ("header_crc", "<u4"),
    ]
)  # fmt: skip
RECORD = np.dtype([("marks", "<u4"), ("ticks", "<u4"), ("x0", "<u2"), ("y0", "<u2"), ("line", "<u2"), ("sweep", "<u2")])
TRAILER = np.dtype(
    [
        ("magic", "S4"), ("status", "<u4"), ("block_seq", "<u8"), ("valid_payload_len", "<u4"), ("payload_crc", "<u4"),
        ("frames_lost", "<u4"), ("crc", "<u4"),
    ]
)  # fmt: skip
INDEX_HEADER_BYTES = 64
INDEX = np.dtype(
    [
        ("segment", "<u4"), ("flags", "<u4"), ("offset", "<u8"), ("length", "<u8"), ("run_id", "<u4"),
        ("block_seq", "<u4"), ("first_frame", "<u8"), ("n_frames", "<u4"), ("sweep", "<u4"), ("t0_ticks", "<u8"),
        ("zero", "<u4"), ("crc", "<u4"),
    ]
)  # fmt: skip

GATE_HIGH, LINE, SCAN, BACKWARD = 1 << 0, 1 << 2, 1 << 3, 1 << 5
MARKERS = LINE | SCAN
POSITION = 0xFF00
PER_FRAME = 256
"""Parts of a frame period in which a marker's time is given."""

Frames = NDArray[np.uint8]


@dataclass(frozen=True)
class Plan:
    """What a recording's plan says of its columns. lit_start_s: from the scan marker until the mirror, which follows
    its command late, is at the first column's edge. commands: of the columns' centres. marker_points: of a sweep."""

    columns: int
    exposures: int
    frame_rate_hz: float
    point_rate_hz: float
    lit_start_s: float
    column_s: float
    commands: NDArray[np.float64]
    marker_points: NDArray[np.int64]

    @classmethod
    def read(cls, folder: Path) -> "Plan":
        """The plan of a recording whose sweeps all go one way."""
        content = yaml.load((folder / "plan.yaml").read_text(), getattr(yaml, "CSafeLoader", yaml.SafeLoader))["plan"]
        (leg,) = content["legs"]
        rate = float(content["point_rate_hz"])
        return cls(
            content["columns"],
            content["exposures"],
            float(content["frame_rate_hz"]),
            rate,
            float(leg["path"]["lit_start"]) / rate + leg["lag_s"],
            float(leg["path"]["lit_points"]) / rate / content["columns"],
            np.array(content["commands"]["values"]),
            np.array(content["marker_points"]["values"]),
        )


class Recording:
    """A recording of one start of the SPAD in one segment.

    records: (frames,) of RECORD. pixels: uint8 (frames, rows, row bytes), packed, most significant bit first. Both may
    be changed; `write` puts them back.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.plan = Plan.read(folder)
        self._bytes = np.fromfile(folder / "frames-000000.spb", np.uint8)
        self._index = np.fromfile(folder / "frames.idx", INDEX, offset=INDEX_HEADER_BYTES)
        parts = [self._views(int(entry["offset"])) for entry in self._index]
        self.header = parts[0][0].copy()
        self.records = np.concatenate([records for _, records, _, _ in parts])
        self.pixels = np.concatenate([pixels for _, _, pixels, _ in parts])
        self._t0 = np.concatenate(
            [np.full(len(records), header["t0_ticks"], np.int64) for header, records, *_ in parts]
        )

    def _views(self, at: int) -> tuple[Any, Any, Frames, Any]:
        """Header, records, pixels and trailer of the block at this offset, to be read and written."""
        header = self._bytes[at : at + HEADER.itemsize].view(HEADER)[0]
        n, rows = int(header["n_frames"]), int(header["height"])
        row_bytes = -(-int(header["width"]) // 64) * 8
        records = self._bytes[at + HEADER.itemsize :][: n * RECORD.itemsize].view(RECORD)
        first, end = at + int(header["pixels_offset"]), at + HEADER.itemsize + int(header["payload_len"])
        pixels = self._bytes[first : first + n * rows * row_bytes].reshape(n, rows, row_bytes)
        return header, records, pixels, self._bytes[end : end + TRAILER.itemsize].view(TRAILER)[0]

    @property
    def width(self) -> int:
        """Pixels of a row."""
        return int(self.header["width"])

    def blocks(self) -> list[int]:
        """Number of the first frame of each block, counted from 0."""
        return [0, *np.cumsum(self._index["n_frames"])[:-1].tolist()]

    def start_ticks(self) -> NDArray[np.int64]:
        """When the exposure of each frame starts."""
        return np.asarray(self._t0 + self.records["ticks"], np.int64)

    def columns(self) -> NDArray[np.float64]:
        """Column of each frame at the middle of its exposure, counted from the first column's centre; NaN before the
        first scan marker. The marker's time comes from the sweep's own scan marker."""
        header, records, start = self.header, self.records, self.start_ticks()
        tick_hz = header["tick_hz"] / header["tick_hz_den"]
        scans = np.flatnonzero(records["marks"] & SCAN)
        position = (records["marks"][scans] & POSITION) >> 8
        at = start[scans] + (position + 0.5) / PER_FRAME * header["frame_period_ticks"]
        which = np.searchsorted(scans, np.arange(len(start)), side="right") - 1
        middle = start + header["exposure_ticks"] / 2
        since_s = np.where(which >= 0, (middle - at[which]) / tick_hz, np.nan)
        return np.asarray((since_s - self.plan.lit_start_s) / self.plan.column_s - 0.5)

    def maps(self) -> list[NDArray[np.int64]]:
        """Frames of the columns of each whole map, in order: columns x exposures of them."""
        wanted, column, found = self.plan.columns * self.plan.exposures, self.columns(), []
        ends = [*np.flatnonzero(self.records["marks"] & SCAN).tolist(), len(column)]
        for first, end in pairwise(ends):
            inside = first + np.flatnonzero(column[first:end] >= -0.5)
            inside = inside[(self.records["marks"][inside] & GATE_HIGH) > 0][:wanted]
            if len(inside) == wanted and end < len(column):
                found.append(inside)
        return found

    def bits(self, frames: Any = slice(None)) -> NDArray[np.bool_]:
        """Unpacked pixels (frames, rows, width) of these frames."""
        return np.unpackbits(self.pixels[frames], axis=2)[:, :, : self.width].astype(np.bool_)

    def put(self, bits: NDArray[np.bool_], frames: Any = slice(None)) -> None:
        """Pack pixels (frames, rows, width) into these frames."""
        packed = np.packbits(bits, axis=2)
        self.pixels[frames, :, : packed.shape[2]] = packed

    def take(self, other: "Recording", frames: Any) -> None:
        """Take pixels and records of these frames from another recording of the same plan, as far as it has them."""
        number = np.arange(len(self.records))[frames]
        number = number[number < len(other.records)]
        self.pixels[number], self.records[number] = other.pixels[number], other.records[number]

    def delay_markers(self, parts: int) -> None:
        """Let all markers come so many 256ths of a frame later, and all that is counted from them."""
        records = self.records
        edges = np.flatnonzero(records["marks"] & MARKERS)
        place = edges * PER_FRAME + ((records["marks"][edges] & POSITION) >> 8) + parts
        kinds = records["marks"][edges] & MARKERS
        lines = records["line"][edges].copy(), records["sweep"][edges].copy()
        records["marks"] &= ~np.uint32(MARKERS | POSITION)
        inside = place // PER_FRAME < len(records)
        at = place[inside] // PER_FRAME
        records["marks"][at] |= kinds[inside] | ((place[inside] % PER_FRAME) << 8).astype(np.uint32)
        last = np.searchsorted(at, np.arange(len(records)), side="right") - 1
        for name, values in zip(("line", "sweep"), lines, strict=True):
            records[name] = np.where(last >= 0, values[inside][np.maximum(last, 0)], 0)

    def write(self, *, sealed: bool = True) -> None:
        """Write the blocks back, with checksums that fit. sealed: as if they had been recorded so, not mixed later: the
        manifest's seal of all frames fits too."""
        seal = 0
        for entry, first in zip(self._index, self.blocks(), strict=True):
            at = int(entry["offset"])
            header, records, pixels, trailer = self._views(at)
            records[:] = self.records[first : first + len(records)]
            pixels[:] = self.pixels[first : first + len(records)]
            # The block's sweep is that of its first frame.
            header["sweep"] = entry["sweep"] = records["sweep"][0]
            header["header_crc"] = zlib.crc32(header.tobytes()[:-4])
            payload = self._bytes[at + HEADER.itemsize :][: int(header["payload_len"])]
            trailer["payload_crc"] = zlib.crc32(payload.tobytes())
            seal = zlib.crc32(trailer["payload_crc"].tobytes(), seal)
            trailer["crc"] = zlib.crc32(trailer.tobytes()[:-4])
            entry["crc"] = zlib.crc32(entry.tobytes()[:-4])
        self._bytes.tofile(self.folder / "frames-000000.spb")
        head = (self.folder / "frames.idx").read_bytes()[:INDEX_HEADER_BYTES]
        (self.folder / "frames.idx").write_bytes(head + self._index.tobytes())
        if sealed:
            file = self.folder / "manifest.json"
            content = json.loads(file.read_text(encoding="utf-8"))
            content["recording"]["payloads_crc32"] = seal
            del content["crc32"]
            content["crc32"] = zlib.crc32(json.dumps(content, sort_keys=True, separators=(",", ":")).encode())
            file.write_text(json.dumps(content), encoding="utf-8")
