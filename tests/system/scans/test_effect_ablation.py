"""What the planner leaves out makes no difference that its bound does not allow: the short form of the campaign."""

from pathlib import Path

import pytest

from rig import api
from tests.campaigns.effect_ablation import ablations


@pytest.mark.long
def test_the_full_model_and_the_plan_differ_by_less_than_the_bound(small: Path, tmp_path: Path) -> None:
    config = api.configure(small)
    config = config.model_copy(update={"scan": config.scan.model_copy(update={"columns": 80})})
    found = {each.scene: each for each in ablations(config, tmp_path, [1], ["clear room", "dense fog"])}
    for each in found.values():
        assert each.within, str(each)
        assert "bit errors" in each.left_out
        assert each.planned_us < each.full_us
    assert {"fog", "halo"} <= set(found["clear room"].left_out)
    assert not {"fog", "halo"} & set(found["dense fog"].left_out)
