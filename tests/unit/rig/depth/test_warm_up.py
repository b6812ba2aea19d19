"""What is compiled before a laser is armed: the frames of a scan must find nothing left to compile."""

from rig.config.files import load_config
from rig.config.models import EstimateConfig
from rig.count import bind_kernels as binding_kernels
from rig.depth.warm_up import warm_binding, warm_up
from rig.devices.open import open_rig
from rig.devices.prepare import prepare


def test_binding_compiles_nothing_more_behind_it():
    from rig.scan.acquisition import Acquisition, AcquisitionRequest
    from rig.scan.scan import make_reconstructor

    with open_rig(load_config("simulated", {"scan.columns": 40, "scan.exposures": 20})) as rig:
        plan, timing = prepare(rig)
        warm_binding(plan)
        made = [len(kernel.signatures) for kernel in (binding_kernels.walk, binding_kernels.cover)]
        assert min(made) >= 1
        estimate = EstimateConfig(estimator="argmax", threads=1)
        maker = make_reconstructor(rig, plan, estimate)
        list(Acquisition(rig, plan, timing, maker, AcquisitionRequest(maps=1)).run())
        assert made == [len(kernel.signatures) for kernel in (binding_kernels.walk, binding_kernels.cover)]


def test_kernels_of_a_halo_are_compiled_for_joint_before_a_map_shows_one(monkeypatch):
    from rig.estimate.joint import solver

    seen = []
    cost_contrast = solver.cost_contrast
    monkeypatch.setattr(solver, "cost_contrast", lambda *args, **named: (seen.append(1), cost_contrast(*args, **named)))
    warm_up.cache_clear()  # another test may have warmed up
    warm_up("joint", "none", 3, dark=False)
    assert seen
    seen.clear()
    warm_up("joint", "none", 3, dark=False)
    assert not seen
