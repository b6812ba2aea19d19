"""A rig that moved is told from corners that are poor, by views of a second simulator."""

from dataclasses import replace

import numpy as np

from calibration.diagnosis.verdicts import judge_fit
from calibration.rig_fit.fit import fit_rig
from tests.reference.boards.calibration_data import BOARD, Seen, TrueRig, random_pose, random_rig, seen_view
from tests.reference.boards.fitted_depth import depth_errors

SIZE = (512, 512)
RIG = TrueRig(lens=(-0.1, 0.03, 5e-4, -3e-4, 0.0), angle=(0.09, 0.53))
SEEN = Seen(passages=200)


def test_views_with_poor_corners_and_single_wrong_ones_are_no_moved_rig() -> None:
    rng = np.random.default_rng(1)
    views = []
    for i in range(10):
        sd_px = 1.0 if i in (2, 5, 8) else 0.05
        view = seen_view(rng, RIG, *random_pose(rng, RIG), replace(SEEN, corner_px=sd_px), name=str(i))
        corners = replace(view.corners, sd_px=np.full(len(view.corners.ids), sd_px))
        if i == 4:
            corners.px[3] += [8.0, 2.4]
        views.append(replace(view, corners=corners))
    judged = judge_fit(fit_rig(views, BOARD, SIZE), views)
    assert judged.verdict.passed, judged.verdict
    assert max(abs(one.shift) / one.sd for one in judged.shifts) < 4


def test_a_knock_is_named_that_the_fit_has_nearly_made_up_for() -> None:
    """What views contradict each other by is less than the accuracy asked, and depth off by three times as much."""
    rng = np.random.default_rng(34)
    rig, seen = random_rig(rng), Seen(passages=200, corner_px=0.02, passage=5e-4)
    moved = rig.moved(np.array([0.001, 0, 0.002]), np.zeros(3))
    views = [seen_view(rng, moved if i >= 4 else rig, *random_pose(rng, rig), seen, name=str(i)) for i in range(9)]
    fit = fit_rig(views, BOARD, SIZE)
    judged = judge_fit(fit, views)
    assert judged.verdict.codes == ("moved-rig",)
    assert judged.evidence.shift_m < 0.6 * judged.asked.accuracy_m
    assert np.median(np.abs(depth_errors(fit.model, moved, 5.0, 35.2)[0])) > 2 * judged.asked.accuracy_m


def test_a_rig_that_moved_is_named_with_the_last_view_before() -> None:
    rng = np.random.default_rng(2)
    moved = RIG.moved(np.array([0.002, 0, 0]), np.radians([0, 0.2, 0]))
    views = [seen_view(rng, moved if i >= 5 else RIG, *random_pose(rng, RIG), SEEN, name=str(i)) for i in range(10)]
    judged = judge_fit(fit_rig(views, BOARD, SIZE), views)
    assert judged.verdict.codes[0] == "moved-rig"
    assert judged.evidence.moved_after == "4"
