"""What estimators make of columns that are lit together: they must know of each other's haze, and then they do well."""

import numpy as np

from tests.reference.scene import procedural_scene
from tests.reference.tables.multi_line import COLUMNS, Lines, measure, working_point

EXPOSURES = 20


def point():
    return working_point(procedural_scene(32, 512), "report")


def test_lines_together_have_the_light_of_each_and_the_ambient_light_once():
    p, k = point(), 4000
    for power, share in (("shared", 0.25), ("each", 1.0)):
        flux = p.ambient + share * sum(p.flux_of_column(c) - p.ambient for c in range(7, COLUMNS, COLUMNS // 4))
        expected = -np.expm1(-flux)
        off = Lines(4, power).counts_at(p, 7, k, seed=1) / k - expected
        assert np.abs(off).max() < 6 * 0.5 / np.sqrt(k)
        assert abs(off.mean()) < 1e-3


def test_told_of_the_other_line_likelihood_finds_what_it_else_takes_for_haze():
    p = point()
    found = {
        told: dict(measure(p, Lines(2, "each"), EXPOSURES, ("likelihood",), told=told))["likelihood"]
        for told in (False, True)
    }
    assert found[True]["within_1px"] > 0.7
    assert found[True]["mean_abs_charged"] < 0.3 * found[False]["mean_abs_charged"]
    assert abs(found[True]["confidence"] - found[True]["within_1px"]) < 0.1
