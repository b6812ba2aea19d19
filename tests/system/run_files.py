"""The files of a run, by name and content."""

import json
from pathlib import Path

import numpy as np

FILES = {
    "depth/000000.npy", "depth/000000.png", "confidence/000000.npz", "confidence/000000.png", "intensity/000000.png",
    "stripe/000000.npz", "cloud/000000.ply", "truth/000000.npz", "manifest.json", "summary.json",
}  # fmt: skip


def strict(text: str) -> dict[str, object]:
    def refuse(word: str) -> float:
        raise ValueError(f"{word} is not JSON")

    content: dict[str, object] = json.loads(text, parse_constant=refuse)
    return content


def files(folder: Path) -> set[str]:
    return {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}


def arrays(run: Path) -> dict[str, bytes]:
    """Every number of every map, by kind, map and name."""
    found = {}
    for kind in ("depth", "stripe", "learned", "truth"):
        for file in sorted((run / kind).glob("*.np[yz]")):
            loaded = np.load(file)
            parts = {"": loaded} if file.suffix == ".npy" else dict(loaded)
            found |= {f"{kind}/{file.stem}/{name}": part.tobytes() for name, part in parts.items()}
    assert found
    return found


def assert_same(run: Path, other: Path) -> None:
    """Both runs have the very same maps."""
    ours, theirs = arrays(run), arrays(other)
    assert ours.keys() == theirs.keys()
    assert [name for name in ours if ours[name] != theirs[name]] == []
