"""Figures that the cases of studies return."""

from rig.api.studies.cases import scan_once
from rig.config.overrides import configure

FIGURES = {
    "verdict", "reasons", "estimator", "maps", "valid_fraction", "sensor_ms", "fog", "stripe_error_px", "depth_error_m",
    "measured",
}  # fmt: skip


def test_what_a_case_returns() -> None:
    config = configure("small", exposures=2, estimator="argmax")
    found = scan_once(config.model_dump(mode="json"), maps=1, seed=0)
    assert set(found) == FIGURES
    assert set(found["stripe_error_px"]) == {"mean_abs", "median_abs", "within_1px", "missing"}
    assert set(found["measured"]) == {"compute_ms"}
    assert found["maps"] == 1
    assert found["sensor_ms"] > 0
