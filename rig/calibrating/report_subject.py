"""What a report is of, so that two of them on a desk can be told apart."""

from collections.abc import Mapping
from datetime import UTC, datetime

from calibration.board.board import Board
from calibration.model.rig_model import Identity


def subject(
    identity: Identity | None, board: Board | None, versions: Mapping[str, str], now: datetime
) -> list[tuple[str, str]]:
    """Rig and serial numbers, board, date and versions, by name; `identity`, `board` None where there is none."""
    rows = []
    if identity is not None:
        rows.append(("rig", identity.name or "unnamed"))
        rows.append(("devices", ", ".join(_devices(identity)) or "not known"))
    if board is not None:
        rows.append(("board", board_words(board)))
    rows.append(("date", now.astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")))
    rows.append(("versions", ", ".join(f"{name} {number}" for name, number in versions.items())))
    return rows


def board_words(board: Board) -> str:
    """A board in one line."""
    squares = f"{board.squares[0]} x {board.squares[1]} squares of {board.square_m * 1e3:.6g} mm"
    if board.marker_m is None:
        return f"chessboard, {squares}"
    return f"ChArUco, {squares}, markers of {board.marker_m * 1e3:.6g} mm, {board.dictionary}"


def _devices(identity: Identity) -> list[str]:
    slots = dict.fromkeys([*identity.kinds, *identity.serials])
    return [
        " ".join(word for word in (slot, identity.kinds.get(slot, ""), identity.serials.get(slot, "")) if word)
        for slot in slots
    ]
