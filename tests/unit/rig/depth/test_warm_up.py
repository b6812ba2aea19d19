"""What is compiled before a laser is armed: the frames of a scan must find nothing left to compile."""

from rig.config.files import load_config
from rig.config.models import EstimateConfig
from rig.count import bind_kernels as binding_kernels
from rig.depth.warm_up import warm_binding
from rig.devices.open import open_rig
from rig.devices.prepare import prepare


def test_binding_compiles_nothing_more_behind_it():
    from rig.depth.reconstruct import Reconstructor
    from rig.scan.acquisition import Acquisition, AcquisitionRequest

    with open_rig(load_config("simulated", {"scan.columns": 40, "scan.exposures": 20})) as rig:
        plan, timing = prepare(rig)
        warm_binding(plan)
        made = [len(kernel.signatures) for kernel in (binding_kernels.walk, binding_kernels.cover)]
        assert min(made) >= 1
        estimate = EstimateConfig(estimator="argmax", threads=1)
        maker = Reconstructor(rig.model, plan.commands, plan.depth_range_m, estimate)
        list(Acquisition(rig, plan, timing, maker, AcquisitionRequest(maps=1)).run())
        assert made == [len(kernel.signatures) for kernel in (binding_kernels.walk, binding_kernels.cover)]
