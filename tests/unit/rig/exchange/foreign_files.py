"""Files as foreign cameras and programs write them, made pixel by pixel from their description
(docs/reference/hardware.md)."""

import numpy as np

Frames = np.ndarray
"""bool (n, rows, columns), upright as the file has them."""


def some_frames(n: int, rows: int, columns: int, seed: int = 0) -> Frames:
    """No two frames, rows or columns alike."""
    return np.random.default_rng(seed).random((n, rows, columns)) < 0.1


def pi_packed(frames: Frames) -> bytes:
    """Most significant bit first, row by row."""
    return np.packbits(frames, axis=2).tobytes()


def pi_sparse(frames: Frames) -> bytes:
    """Numbers of the pixels that fired, row by row; the number of pixels closes a frame."""
    words = [[*np.flatnonzero(frame).tolist(), frame.size] for frame in frames]
    return np.array([word for frame in words for word in frame], "<u4").tobytes()


def swissspad2_half(frames: Frames) -> bytes:
    """Least significant bit first, row by row."""
    return np.packbits(frames, axis=2, bitorder="little").tobytes()


def swissspad2_full(frames: Frames) -> bytes:
    """256 rows of 1024 pixels in 8 zones: upper and lower half in turn, the lower one from its bottom upward."""
    buffer = np.zeros((len(frames), 256, 1024), bool)
    for quarter in range(4):
        columns = slice(128 * quarter, 128 * quarter + 128)
        for row in range(256):
            buffer[:, row, 256 * quarter : 256 * quarter + 128] = frames[:, row, columns]
            buffer[:, row, 256 * quarter + 128 : 256 * quarter + 256] = frames[:, 511 - row, columns]
    return np.packbits(buffer, axis=2, bitorder="little").tobytes()
