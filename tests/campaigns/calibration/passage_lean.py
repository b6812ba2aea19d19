"""By how much passages lean to one side, by where in its column a narrow bright line crosses a pixel.

    python -m tests.campaigns.calibration.passage_lean

Lines of several widths (columns) and strengths (photons of an exposure times columns) that stand still in each column,
as from a converter's stairs, or move on; 10 exposures, other photons than `sim_backend`'s. The figure is the largest
mean error, in columns, of passages in one eighth of a column, and by how many of its standard deviations: 2 to 3 are
chance.
"""

import argparse

import numpy as np

from calibration.passages.find import find_passages
from tests.unit.calibration.passed_lines import Light, passed, sweep_of, true_at

SIGMAS = (0.25, 0.3, 0.4, 0.6)
STRENGTHS = (4.0, 20.0, 70.0)
EXPOSURES, PIXELS, EIGHTHS = 10, 6000, 8


def lean(light: Light, seed: int) -> tuple[float, float]:
    """Largest mean error over eighths of a column, in columns, and in standard deviations of that mean."""
    counts, centre = passed(np.random.default_rng(seed), light, EXPOSURES, pixels=PIXELS)
    found = find_passages(sweep_of(counts, EXPOSURES), 1, 1.0, most=PIXELS)
    true = true_at(centre, found)
    part, error = ((true % 1) * EIGHTHS).astype(int), found.command - true
    eighths = [error[part == i] for i in range(EIGHTHS)]
    worst = max(eighths, key=lambda of_part: float(abs(of_part.mean())))
    off = float(abs(worst.mean()))
    return off, off / float(worst.std()) * np.sqrt(len(worst))


def main() -> None:
    """Print a row per line, a figure per seed."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for travels in (False, True):
        for sigma in SIGMAS:
            for strength in STRENGTHS:
                seen = [lean(Light(sigma, strength, travels=travels), seed) for seed in (4, 5)]
                figures = ", ".join(f"{columns:.3f} ({sds:.0f} sd)" for columns, sds in seen)
                print("moves on    " if travels else "stands still", f"width {sigma:g}, {strength:g}: {figures}")


if __name__ == "__main__":
    main()
