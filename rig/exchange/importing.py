"""`rig import`: makes a recording from the frames of another program.

Foreign files contain pixels and little else. What they do not say is left open in the recording: there are no markers,
and without a frame rate no clock (`frame_period_ticks` 0, one tick per frame). The pixels are those of the files,
turned upright where necessary.
"""

import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from calibration.errors import digits
from drivers.frames import FRAME_RECORD, BlockFlag, BlockHeader, FrameBlock, frame_bytes, packed_row_bytes
from drivers.spads.orientation import QuarterTurn, turn_packed, turned_size
from drivers.spb1 import BlockLayout, frames_per_block
from drivers.units import parse_exact
from rig.config.overrides import PathLike
from rig.errors import UsageError
from rig.exchange import photoncube, raw_files
from rig.exchange.foreign import ForeignFrames, gather
from rig.progress import Progress, counted
from rig.recording.writer import Recording
from rig.requests import ImportRequest
from rig.run_folder.folder import RunFolder
from rig.run_folder.manifest import MANIFEST
from rig.scan.run import versions


class _Kind(NamedTuple):
    """A kind of foreign files. forms: names for `form`. upright_deg: the turn that makes their frames upright."""

    suffix: str
    forms: tuple[str, ...]
    open: Callable[[list[Path], ImportRequest], ForeignFrames]
    upright_deg: QuarterTurn = 0


_KINDS: Final = {
    # The vendor's samples and the driver (`rotation`) turn frames by 90 degrees.
    "pi-imaging": _Kind(".bin", raw_files.PI_IMAGING_FORMS, raw_files.open_pi_imaging, 90),
    "swissspad2": _Kind(".bin", raw_files.SWISSSPAD2_FORMS, raw_files.open_swissspad2),
    "photoncube": _Kind(".npy", photoncube.FORMS, photoncube.open_photoncube),
}
_RUN_ID: Final = 1
_BLOCK_BYTES: Final = 1 << 20
_MAX_TICK_HZ: Final = 0xFFFFFFFF
"""Largest numerator and denominator of a clock that a block's header can hold."""
_MIN_RATE_HZ: Final = 0.001


@dataclass(frozen=True, slots=True)
class ImportResult:
    """Result of an import. frame_rate_hz: None if unknown. gaps: (first, last) of frames that the source says were
    lost. hints: lines for the user about what may be wrong."""

    folder: Path
    kind: str
    frames: int
    width: int
    height: int
    frame_rate_hz: float | None
    gaps: tuple[tuple[int, int], ...]
    blocks: int
    bytes: int
    hints: tuple[str, ...]


def import_frames(
    kind: str,
    files: Iterable[PathLike],
    out: PathLike,
    request: ImportRequest | None = None,
    *,
    progress: Progress | None = None,
    **changes: Any,
) -> ImportResult:
    """Make a recording from the frames of another program (`rig import`). Its folder appears only once it is complete.

    kind: pi-imaging, swissspad2 or photoncube.
    files: in order; a folder stands for the files in it.
    request, changes: how files are read, as an `ImportRequest` or by the names of its fields.
    progress: called with the number of frames done and the total.
    Raises UsageError, one line per problem, for files or options that cannot be used; RecordingError if writing fails.
    """
    request = replace(request or ImportRequest(), **changes)
    asked = request.frame_rate
    try:
        given = parse_exact(asked, "frequency") if isinstance(asked, str) else asked
    except ValueError as error:
        raise UsageError(f"frame rate {error}") from None
    turn = _checked_turn(kind, request)
    sources = gather(files, _KINDS[kind].suffix)
    foreign = _KINDS[kind].open(sources, request)
    if turn and (foreign.width % 8 or foreign.height % 8):
        raise UsageError(
            f"frames of {foreign.width} x {foreign.height} pixels cannot be turned, sizes that are no multiples of 8 "
            "stay as they are; import with `turn_deg=0`"
        )
    rate = foreign.frame_rate if given is None else given
    if rate is not None and not _MIN_RATE_HZ <= rate <= _MAX_TICK_HZ:
        raise UsageError(f"frame rate {float(rate):g} Hz is outside {_MIN_RATE_HZ} to {_MAX_TICK_HZ} Hz")
    width, height = turned_size(foreign.width, foreign.height, turn)
    ranges = foreign.ranges or ((0, foreign.n_frames),)
    gaps = tuple((first + n, after - 1) for (first, n), (after, _) in pairwise(ranges))
    with RunFolder(out) as folder:
        expected = foreign.n_frames * frame_bytes(width, height)
        scratch = folder.place("")
        free = shutil.disk_usage(scratch).free
        if expected > free:
            raise UsageError(
                f"the recording will take {digits(expected / 1e9)} GB, the disk of {scratch.parent} has "
                f"{digits(free / 1e9)} GB free; free some or name a folder on another disk as `out`"
            )
        with closing(Recording(scratch, expected_bytes=expected)) as recording:
            done, told = 0, counted("reading", "frames", progress)
            for block in _blocks(foreign, turn, ranges, rate):
                recording.append(block)
                done += block.n_frames
                told(done, foreign.n_frames)
        manifest: dict[str, Any] = {
            "versions": versions(),
            "command": "import",
            "import": {
                "kind": kind,
                "files": [file.absolute() for file in sources],
                **foreign.origin,
                "turned_deg": turn,
                "width": width,
                "height": height,
                "frame_rate_hz": rate,
                "frames": foreign.n_frames,
            },
            "gaps": gaps,
            "recording": recording.content(),
            "verdict": "gaps" if gaps else "complete",
        }
        if ranges[0][0]:  # the first frame is not number 0, as after 'rig cut'
            manifest["cut"] = {"frames": [[_RUN_ID, ranges[0][0], sum(ranges[-1])]]}
        folder.write_json(MANIFEST, manifest)
        path = folder.publish()
    return ImportResult(
        path, kind, foreign.n_frames, width, height, None if rate is None else float(rate), gaps,
        recording.blocks, recording.bytes, tuple(foreign.hints),
    )  # fmt: skip


def _checked_turn(kind: str, request: ImportRequest) -> QuarterTurn:
    """The turn in degrees. Raises UsageError for options that do not fit the kind."""
    if kind not in _KINDS:
        raise UsageError(f"import kind {kind!r} is unknown; choose one of {', '.join(_KINDS)}")
    forms, form, rows, turns = _KINDS[kind].forms, request.form, request.rows, get_args(QuarterTurn)
    turn = _KINDS[kind].upright_deg if request.turn_deg is None else request.turn_deg
    has_rows, stated = kind == "pi-imaging", rows is not None
    checks = [
        (form not in (None, *forms), f"{kind} has no form {form!r}; choose {' or '.join(forms)}, or leave `form` out"),
        (turn not in turns, f"frames cannot be turned by {turn} degrees; choose one of {', '.join(map(str, turns))}"),
        (stated and not has_rows, f"rows is {rows}, but {kind} files say their size themselves; leave `rows` out"),
        (has_rows and rows not in (None, 512, 1024), f"rows is {rows}; a SPAD512S has 512, its 1M flavour 1024"),
    ]
    if problems := [line for wrong, line in checks if wrong]:
        raise UsageError.of(problems)
    return next(one for one in turns if one == turn)


def _turned(foreign: ForeignFrames, turn: QuarterTurn) -> Iterator[NDArray[np.uint8]]:
    """Yield upright chunks uint8 (n, height, row bytes), with rows padded to whole 64-bit words by bits of 0."""
    width, height = turned_size(foreign.width, foreign.height, turn)
    last_byte = np.uint8(0xFF << (-foreign.width % 8) & 0xFF)
    for chunk in foreign.chunks():
        bits = np.zeros((len(chunk), height, packed_row_bytes(width)), np.uint8)
        pixels = bits[:, :, : -(-width // 8)]
        if turn:
            turn_packed(np.ascontiguousarray(chunk), turn, pixels)
        else:
            pixels[:] = chunk
            pixels[:, :, -1] &= last_byte
        yield bits


def _clock(rate: Fraction | None) -> tuple[Fraction, int]:
    """Tick rate in Hz and ticks per frame: 1000, 100, 10 or 1, as many as a header can hold. 1 and 1 without a rate."""
    if rate is None:
        return Fraction(1), 1
    rate = rate.limit_denominator(_MAX_TICK_HZ // max(1, -(-rate.numerator // rate.denominator)))
    ticks = next((n for n in (1000, 100, 10) if (rate * n).numerator <= _MAX_TICK_HZ), 1)
    return rate * ticks, ticks


def _blocks(
    foreign: ForeignFrames, turn: QuarterTurn, ranges: Iterable[tuple[int, int]], rate: Fraction | None
) -> Iterator[FrameBlock]:
    """Yield blocks of consecutive upright frames; the first block and the last one are flagged as such."""
    width, height = turned_size(foreign.width, foreign.height, turn)
    tick_hz, ticks = _clock(rate)
    stride = max(_BLOCK_BYTES, BlockLayout(1, width, height).min_stride)
    most = frames_per_block(stride, width, height)
    left = [[first, n] for first, n in ranges]
    expected = left[0][0]
    seq = lost_before = 0
    for bits in _turned(foreign, turn):
        at = 0
        while at < len(bits):
            first, n = left[0]
            take = min(most, n, len(bits) - at)
            flags = BlockFlag(0) if seq else BlockFlag.FIRST
            if first > expected:
                flags |= BlockFlag.LOST_BEFORE
            lost_before += first - expected
            left[0] = [first + take, n - take]
            if take == n:
                left.pop(0)
            if not left:
                flags |= BlockFlag.LAST
            records = np.zeros(take, FRAME_RECORD)
            records["ticks"] = np.arange(take) * ticks
            header = BlockHeader(
                flags, _RUN_ID, seq, first, first * ticks, lost_before, tick_hz,
                0 if rate is None else ticks, ticks, 0, 1, width, height, width, height,
            )  # fmt: skip
            yield FrameBlock(header, records, bits[at : at + take])
            at += take
            expected = first + take
            seq += 1
