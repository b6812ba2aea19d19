"""Compiles every kernel that a rig's scans can need: estimators, filters and, if the rig is simulated, its world.

Each kernel is run once on little data. numba keeps the compiled code on disk, so that another call takes only seconds.
"""

import time
from contextlib import closing, suppress

import numpy as np

from rig.bench.speed import warm_bench
from rig.config.models import EstimateConfig, RigConfig
from rig.depth.warm_up import warm_up
from rig.devices.open import OpenRig, open_rig
from rig.devices.prepare import prepare
from rig.estimate.registry import ESTIMATORS
from rig.progress import tell_stage
from rig.scan.acquisition import Acquisition, AcquisitionRequest
from rig.scan.monitor import Listeners, ScanProgress
from rig.scan.scan import make_reconstructor

ENOUGH_FRAMES = 1000
"""Number of frames that are simulated, the first columns of a sweep among them."""


def warm_rig(config: RigConfig) -> float:
    """Compile everything that the rig needs, and return the seconds it took. Devices are opened only if the rig has a
    simulated world."""
    begun = time.perf_counter()
    for done, estimator in enumerate(ESTIMATORS):
        tell_stage("warming up", done, len(ESTIMATORS), "estimators")
        for dark in (True, False):  # a scan has dark frames, a bare cube has none
            warm_up(estimator, "median", config.scan.exposures, dark=dark)
    tell_stage("warming up the bench")
    warm_bench()
    if config.world is not None:
        with open_rig(config) as rig:
            tell_stage("warming up the simulator")
            _simulate(rig)
    return time.perf_counter() - begun


class _EnoughError(Exception):
    """Raised when enough frames were simulated."""


def _simulate(rig: OpenRig) -> None:
    """Let the world make the first frames of a scan, bind and count them, and ask for the truth of two columns."""
    plan, timing = prepare(rig)
    maker = make_reconstructor(rig, plan, EstimateConfig(estimator="argmax", threads=1))

    def enough(done: ScanProgress) -> None:
        if done.frames >= ENOUGH_FRAMES:
            raise _EnoughError

    request = AcquisitionRequest(maps=1, listeners=Listeners(live=enough))
    running = Acquisition(rig, plan, timing, maker, request).run()
    with closing(running), suppress(_EnoughError):
        for _ in running:
            pass
    assert rig.world is not None, "only a simulated rig is asked for frames"
    rig.world.truth(plan.command_at(np.arange(2.0)))
