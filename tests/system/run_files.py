"""The files of a run, by name and content."""

import json
from pathlib import Path

FILES = {
    "depth/000000.npy", "depth/000000.png", "intensity/000000.png", "stripe/000000.npz", "cloud/000000.ply",
    "truth/000000.npz", "manifest.json", "summary.json",
}  # fmt: skip


def strict(text: str) -> dict[str, object]:
    def refuse(word: str) -> float:
        raise ValueError(f"{word} is not JSON")

    content: dict[str, object] = json.loads(text, parse_constant=refuse)
    return content


def files(folder: Path) -> set[str]:
    return {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}
