"""Several lines in a config: what is taken, what is refused and how, and rigs made of others."""

import pytest

from rig.config.files import load_config, parse_config
from rig.config.models import line_problems
from rig.config.overrides import with_lines
from rig.errors import UsageError

SIMULATED = load_config("simulated")


def changed(**sections):
    content = SIMULATED.model_dump(mode="json")
    for name, value in sections.items():
        content[name] = {**content[name], **value} if isinstance(value, dict) else value
    return parse_config(content)


def refused(**sections):
    with pytest.raises(UsageError) as caught:
        changed(**sections)
    return str(caught.value)


def test_the_bundled_rig_has_four_lines_that_tile_the_field_of_the_one():
    four = load_config("simulated-4-lines")
    assert four.line_offsets == pytest.approx(with_lines(SIMULATED, 4).line_offsets)
    assert four.scan.command_range == pytest.approx(with_lines(SIMULATED, 4).scan.command_range)
    assert four.scan.columns == SIMULATED.scan.columns


@pytest.mark.parametrize(
    ("offsets", "part"),
    [
        ([], "names 0 lines; a rig has 1 to 16"),
        ([0.1], "a single line stands at 0"),
        ([0.2, -0.2], "must ascend"),
        ([0.1, 0.1], "must ascend"),
        ([0.0, 2.5], "2"),
        ([0.0, "1 m"], "line_offsets"),
        ([i / 10 for i in range(17)], "names 17 lines; a rig has 1 to 16"),
    ],
)
def test_offsets_that_cannot_be_are_refused(offsets, part):
    text = refused(line_offsets=offsets)
    assert "line_offsets" in text
    assert part in text


def test_all_that_does_not_fit_the_scan_is_told_with_its_remedy():
    text = refused(line_offsets=[-0.5, 0.0, 0.9], scan={"command_range": [-0.3, 0.3]})
    assert "scan.columns is 500, no multiple of the 3 lines of line_offsets; make it 498 or 501" in text
    assert "0 and 0.9 are 0.9 apart, scan.command_range spans 0.6: what lies between them is never lit" in text
    assert "widen it to 0.9 or bring the lines closer" in text


def test_neighbours_may_miss_each_other_by_a_column_and_share_some():
    for apart in (0.4, 0.45, 0.5, 0.509):
        assert line_problems([0.0, apart], 100, (-0.25, 0.25)) == []
    assert line_problems([0.0, 0.52], 100, (-0.25, 0.25))
    assert "narrow it to 0.2" in line_problems([0.0, 0.2], 100, (-0.3, 0.3))[0]


@pytest.mark.parametrize("lines", [1, 3])
@pytest.mark.parametrize("ends", [(-0.88, 0.88), (0.6, -0.2)])
def test_a_rig_with_more_lines_covers_the_same_field(lines, ends):
    one = changed(scan={"command_range": ends})
    many = with_lines(one, lines, "each")
    first, last = many.scan.command_range
    covered = sorted(offset + end for offset in many.line_offsets for end in (first, last))
    assert (covered[0], covered[-1]) == pytest.approx(tuple(sorted(ends)))
    assert many.scan.columns == 500 // lines * lines
    assert (last > first) == (ends[1] > ends[0])
    assert many.line_power == "each"


def test_more_lines_are_made_of_one_only():
    with pytest.raises(UsageError, match="has 4 lines already"):
        with_lines(load_config("simulated-4-lines"), 2)
    with pytest.raises(UsageError, match="lines is 17; it must be 1 to 16"):
        with_lines(SIMULATED, 17)
