import pytest

from rig.estimators.stream import ColumnJudge
from rig.warm_up import warm_up


@pytest.mark.parametrize("exposures", [1, 10, 100])
@pytest.mark.parametrize("dark", [True, False])
def test_columns_are_judged_on_the_way_before_a_run_needs_it(monkeypatch, exposures, dark):
    judged = []
    finish = ColumnJudge.finish
    monkeypatch.setattr(ColumnJudge, "finish", lambda self: judged.append(self) or finish(self))
    warm_up("likelihood", "none", exposures, dark=dark)
    assert judged
