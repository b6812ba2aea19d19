"""`rig scan --temporal-prior`: maps that lean on those before come out of a part of the recording the same."""

from pathlib import Path

import numpy as np
import pytest

from rig import api
from rig.errors import UsageError
from tests.system.small_rig import write_rig


def stripes(run: Path) -> list[dict[str, np.ndarray]]:
    return [dict(np.load(file)) for file in sorted((run / "stripe").glob("*.npz"))]


@pytest.mark.long
def test_a_part_gives_the_maps_of_the_whole_bit_for_bit(tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "rig")
    options = {"maps": 3, "seed": 5, "estimator": "joint", "exposures": 2}
    api.scan(rig, out=tmp_path / "whole", record=True, temporal_prior=True, **options)
    api.scan(rig, out=tmp_path / "without", **options)
    api.cut(tmp_path / "whole", tmp_path / "part", maps="1:3")
    for run in ("whole", "part"):
        api.reconstruct(tmp_path / run, out=tmp_path / f"{run} again")
    scanned = stripes(tmp_path / "whole")
    for again, first in (("whole again", 0), ("part again", 1)):
        found = stripes(tmp_path / again)
        assert len(found) == 3 - first
        for one, other in zip(found, scanned[first:], strict=True):
            for name, values in other.items():
                np.testing.assert_array_equal(one[name], values, err_msg=f"{again} {name}")
    api.reconstruct(tmp_path / "part", estimator="likelihood")  # knows no prior, and is not asked for one
    learned = [set(np.load(tmp_path / "whole" / "learned" / f"{i:06d}.npz")) for i in range(3)]
    assert ["before" in names for names in learned] == [False, True, True]
    assert not np.array_equal(stripes(tmp_path / "without")[1]["x_px"], scanned[1]["x_px"], equal_nan=True)


def test_it_is_for_joint(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="`temporal_prior` is for the estimator joint, this is argmax"):
        api.configure(write_rig(tmp_path), temporal_prior=True)
    with_prior = api.configure(write_rig(tmp_path), estimator="joint", temporal_prior=True)
    with pytest.raises(UsageError, match=r"estimate.temporal_prior is for the estimator joint, this is likelihood"):
        api.configure(with_prior, estimator="likelihood")
    with pytest.raises(UsageError, match=r"has estimate.temporal_prior, which is for joint alone"):
        api.tradeoff(with_prior)
