"""`rig scan --learned FILE`: what a scan has learned serves the next one's first map, if it explains that map."""

from pathlib import Path

import numpy as np
import pytest

from rig import api
from rig.errors import UsageError
from tests.system.small_rig import config, write_rig


def stripes(run: Path) -> dict[str, np.ndarray]:
    return dict(np.load(run / "stripe" / "000000.npz"))


def test_the_next_scan_begins_with_what_was_learned(tmp_path: Path) -> None:
    rig, kept = write_rig(tmp_path / "rig"), tmp_path / "learned.npz"
    options = {"estimator": "joint", "learned": kept}
    first = api.scan(rig, seed=1, out=tmp_path / "first", **options)
    assert first.summary.learned == f"anew, {kept} is written at the end"
    second = api.scan(rig, seed=2, out=tmp_path / "second", record=True, **options)
    assert second.summary.learned == f"from {kept}"
    state, used = (np.load(tmp_path / run / "learned" / "000000.npz") for run in ("first", "second"))
    for name in ("amplitude", "weight", "line_sigma_px"):
        np.testing.assert_array_equal(used[name], state[name])
    fresh = api.scan(rig, seed=2, estimator="joint")
    assert fresh.summary.learned == ""
    assert fresh.summary.truth is not None
    assert second.summary.truth is not None
    errors = [run.summary.truth.stripe_error_px["mean_abs"] for run in (second, fresh)]
    assert errors[0] < 1.1 * errors[1] + 0.01

    # A recording carries the state that it began with, whatever has become of the file.
    kept.unlink()
    again = api.reconstruct(tmp_path / "second", out=tmp_path / "again")
    assert again.summary.learned == f"from {tmp_path / 'second' / 'learned.npz'}"
    for name, values in stripes(tmp_path / "second").items():
        np.testing.assert_array_equal(stripes(tmp_path / "again")[name], values, err_msg=name)
    assert not kept.exists()


@pytest.mark.long
def test_what_does_not_explain_the_first_map_is_learned_anew(tmp_path: Path) -> None:
    rig, kept = write_rig(tmp_path / "rig"), tmp_path / "learned.npz"
    api.scan(rig, seed=1, estimator="joint", learned=kept)
    before = kept.read_bytes()
    foggy = api.configure(rig, fog="30 m", estimator="joint")
    other = api.scan(foggy, seed=2, learned=kept)
    assert other.summary.learned == f"anew: {kept} does not explain the first map"
    assert other.summary.truth == api.scan(foggy, seed=2).summary.truth
    assert kept.read_bytes() != before, "what was learned anew is kept"
    assert api.scan(foggy, seed=3, learned=kept).summary.learned == f"from {kept}"


@pytest.mark.long
def test_a_halo_is_kept_with_its_medium(tmp_path: Path) -> None:
    rig, kept = api.configure(write_rig(tmp_path), scene="street-dense-fog", exposures=20), tmp_path / "learned.npz"
    api.scan(rig, seed=1, estimator="joint", learned=kept)
    state = np.load(kept)
    assert state["halo"].any()
    second = api.scan(rig, seed=2, estimator="joint", out=tmp_path / "second", learned=kept)
    assert second.summary.learned == f"from {kept}"
    used = np.load(tmp_path / "second" / "learned" / "000000.npz")
    for name in used.files:
        np.testing.assert_array_equal(used[name], state[name])
    cleared = api.scan(api.configure(rig, fog="60 m"), seed=3, estimator="joint", learned=kept)
    assert cleared.summary.learned == f"anew: {kept} does not explain the first map"


def test_what_was_learned_otherwise_is_learned_anew(tmp_path: Path) -> None:
    rig, kept = write_rig(tmp_path / "rig"), tmp_path / "learned.npz"
    for name in ("argmax", "likelihood"):
        assert "learned" not in api.scan(rig, estimator=name, learned=kept).summary.as_json()
    assert not kept.exists(), "only joint keeps what it has learned"
    options = {"estimator": "joint", "learned": kept}
    api.scan(rig, **options)
    content = config()
    content["scan"]["columns"] //= 2
    fewer = api.scan(write_rig(tmp_path / "fewer", content), **options).summary
    assert fewer.learned == f"anew: {kept} was learned from frames or columns of another size or number"
    near, far = content["scan"]["depth_range"]
    content["scan"]["depth_range"] = [near, f"{float(far.split()[0]) + 1} m"]
    deeper = api.scan(write_rig(tmp_path / "deeper", content), **options).summary
    assert deeper.learned == f"anew: {kept} was learned for another depth range"


def test_a_wrong_file_is_named_before_anything_moves(tmp_path: Path) -> None:
    rig, file = write_rig(tmp_path / "rig"), tmp_path / "learned.npz"
    with pytest.raises(UsageError, match=r"there is no folder .*nowhere; make it, or name another file"):
        api.scan(rig, estimator="joint", learned=tmp_path / "nowhere" / "learned.npz")
    file.write_bytes(b"no archive")
    with pytest.raises(UsageError, match="holds nothing that joint has learned"):
        api.scan(rig, estimator="joint", learned=file)
    np.savez(file, profile=np.zeros((2, 2)))
    with pytest.raises(UsageError, match="it has no 'w_lo'"):
        api.scan(rig, estimator="joint", learned=file)
    api.scan(rig, estimator="joint", learned=(good := tmp_path / "good.npz"))
    np.savez(file, **{**np.load(good), "profile": np.zeros((2, 2), np.float32)})
    with pytest.raises(UsageError, match=r"profile is of \(2, 2\) numbers, not \(64, 4\)"):
        api.scan(rig, estimator="joint", learned=file)


def test_a_path_in_a_config_is_beside_it(tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "rig", config() | {"estimate": {"estimator": "joint", "learned": "kept.npz"}})
    api.scan(rig)
    assert (tmp_path / "rig" / "kept.npz").exists()
    assert str(tmp_path / "rig" / "kept.npz") in api.scan(rig).summary.learned
