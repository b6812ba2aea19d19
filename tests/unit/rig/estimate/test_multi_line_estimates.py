"""What estimators make of columns that are lit together: they must know of each other's haze, and then they do well."""

from tests.reference.scene import procedural_scene
from tests.reference.tables.multi_line import Lines, measure, working_point


def test_told_of_the_other_line_likelihood_finds_what_it_else_takes_for_haze():
    p = working_point(procedural_scene(32, 512), "report")
    found = {
        told: dict(measure(p, Lines(2, "each"), 20, ("likelihood",), told=told))["likelihood"] for told in (False, True)
    }
    assert found[True]["within_1px"] > 0.7
    assert found[True]["mean_abs_charged"] < 0.3 * found[False]["mean_abs_charged"]
    assert abs(found[True]["confidence"] - found[True]["within_1px"]) < 0.1
