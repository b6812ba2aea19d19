"""Makes pictures of a run: depth maps, their intensity, or sums of recorded frames; as PNG files or as an MP4 film."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from drivers.frames import FrameBlock
from rig.errors import UsageError
from rig.exchange.npy import MapFiles, load
from rig.run_folder.folder import RunFolder
from rig.run_folder.map_files import read_arrays, read_depth
from rig.run_folder.pictures import (
    Picture,
    beside,
    confidence_picture,
    depth_limits,
    depth_picture,
    png_bytes,
    read_grey,
)
from rig.scan.monitor import add_frames

View = Literal["depth", "intensity", "frames"]
VIEWS: Final[tuple[View, ...]] = get_args(View)
_BRIGHT_SHARE: Final = 0.999
"""Quantile of the first picture's pixel values that is shown as white."""
_MOST_PIXELS: Final = 1 << 24
"""Most pixels of a picture of frames: five times as many as the largest SPAD array has."""


def map_pictures(maps: MapFiles, view: View) -> Iterator[Picture]:
    """Make one picture of each map: of its depth, with its confidence beside it if the folder holds that, or of its
    intensity. The colour scale of the first depth map with any depth is kept for all later ones.

    Raises UsageError if a file cannot be read."""
    if view == "intensity":
        for file in maps.files("intensity", ".png"):
            try:
                yield read_grey(file)
            except (OSError, ValueError) as error:
                raise UsageError(f"{file}: {error}; make the maps again with rig reconstruct") from error
        return
    limits = None
    for file in maps.files("depth", ".npy"):
        depth_m = load(file, read_depth)
        limits = limits or depth_limits(depth_m)
        picture = depth_picture(depth_m, limits)
        worth = file.parent.parent / "confidence" / f"{file.stem}.npz"
        if worth.exists():
            picture = beside(picture, confidence_picture(load(worth, _confidence)))
        yield picture


def _confidence(file: Path) -> NDArray[np.float32]:
    """The confidence of each pixel's depth. Raises OSError, ValueError."""
    arrays = read_arrays(file)
    if "confidence" not in arrays:
        raise ValueError(f"{file.name} has no confidence")
    return arrays["confidence"]


def frame_pictures(blocks: Iterable[FrameBlock], frames_per_picture: int) -> Iterator[Picture]:
    """Sum received frames in groups, and draw the square roots of the sums as grey levels, for the whole sensor.

    An incomplete last group is left out. The brightest pixels of the first picture set the level of white for all, so
    that a film does not flicker. Raises UsageError if a block names a sensor too large for a picture.
    """
    white = 0.0
    for counts in _sums(blocks, frames_per_picture):
        white = white or max(1.0, float(np.quantile(counts, _BRIGHT_SHARE)))
        yield np.sqrt(np.minimum(counts / white, 1.0) * 255.0**2).round().astype(np.uint8)


def write_pngs(pictures: Iterable[Picture], folder: RunFolder, name: str) -> int:
    """Write NAME-000000.png and so on; returns the number of files."""
    n = 0
    for n, picture in enumerate(pictures, start=1):
        folder.place(f"{name}-{n - 1:06d}.png").write_bytes(png_bytes(picture))
    return n


def write_mp4(pictures: Iterable[Picture], path: Path, pictures_per_s: float) -> int:
    """Write a film (MPEG-4 part 2); returns its number of pictures. Without pictures no file is written. Raises
    UsageError if this OpenCV writes no films or only a part of the film was written."""
    import cv2

    film = None
    n = 0
    try:
        for picture in pictures:
            frame = np.repeat(picture[:, :, None], 3, axis=2) if picture.ndim == 2 else picture[..., ::-1]
            height, width = frame.shape[:2]
            frame = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)))  # the format asks for even sides
            if film is None:
                codec = cv2.VideoWriter.fourcc(*"mp4v")
                film = cv2.VideoWriter(str(path), codec, pictures_per_s, frame.shape[1::-1])
                if not film.isOpened():
                    raise UsageError("this OpenCV writes no MP4; export png and make the film with another program")
            film.write(frame)
            n += 1
    finally:
        if film is not None:
            film.release()
    if n and cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT) != n:  # OpenCV reports no full disk
        raise UsageError(f"only a part of the film could be written; is the disk of {path.parent} full?")
    return n


def _sums(blocks: Iterable[FrameBlock], n: int) -> Iterator[NDArray[np.uint32]]:
    """Yield sums of n frames each, uint32 (sensor height, sensor width), with the frames' windows in their places."""
    counts: NDArray[np.uint32] | None = None
    missing = n
    for block in blocks:
        header, at = block.header, 0
        while at < block.n_frames:
            if counts is None:
                size = header.sensor_height, header.sensor_width
                if size[0] * size[1] > _MOST_PIXELS:  # a damaged header may name any size
                    raise UsageError(
                        f"the recording says that its sensor has {size[1]} x {size[0]} pixels; pictures have at most "
                        f"{_MOST_PIXELS}; 'rig export' the frames as npy, which are only as large as their windows"
                    )
                counts = np.zeros(size, np.uint32)
            take = min(missing, block.n_frames - at)
            add_frames(counts, block, at, at + take)
            at, missing = at + take, missing - take
            if missing == 0:
                yield counts
                counts, missing = None, n
