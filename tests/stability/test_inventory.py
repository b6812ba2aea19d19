"""Every public numeric function is taken through its domain by a test of this folder, or excused with a reason."""

from fnmatch import fnmatchcase

from tests.stability.inventory import ROOT, covered, public_functions

ELSEWHERE = {
    "whole numbers and bits in other orders, against plain loops": (
        "tests/unit/rig/count/test_lane_order.py",
        "rig.count.lane_order:*",
    ),
    "statistics of a map, for maps that are right and wrong": (
        "tests/unit/rig/count/test_map_checks.py",
        "rig.count.map_checks:*",
        "rig.count.map_check_kernels:*",
    ),
    "limits that a config states": (
        "tests/unit/drivers/test_waveform_limits.py",
        "drivers.scanners.galvo:GalvoConfig.limits",
    ),
    "the steps of a map, whose numbers the tests of each step hold": (
        "tests/unit/rig/depth/test_reconstruct.py",
        "rig.depth.reconstruct:Reconstructor.*",
        "rig.depth.warm_up:warm_up",
    ),
    "the mean places of columns": (
        "tests/unit/sim/test_photons.py",
        "sim_backend.frames.flux:CommandGrid.hold",
        "sim_backend.frames.flux:*_grid",
    ),
    "exact whole numbers, against unpacked sums": (
        "tests/unit/rig/count/test_kernels.py",
        "rig.count.kernels:*",
    ),
    "columns from the frame number, exactly": (
        "tests/unit/rig/count/test_cube.py",
        "rig.recording.cube:*",
    ),
    "what a sweep is made of, frame by frame": (
        "tests/unit/rig/count/test_bind.py",
        "rig.count.bind_kernels:cover",
        "rig.count.sweeps:*",
    ),
    "places and numbers that the light gives, with the patterns of test_plans.py": (
        "tests/unit/rig/count/test_blanking.py",
        "rig.count.blanking:*",
    ),
    "asks the search of test_plans.py again": (
        "tests/unit/rig/plan/test_compile.py",
        "rig.plan.mirror_path:remedy",
    ),
    "whole-number tables and lanes of the compiled search; its answers for any counts in test_estimators.py": (
        "tests/unit/rig/estimate/search/test_rows.py",
        "rig.estimate.search.scores:*",
        "rig.estimate.search.rows:*",
        "rig.estimate.search.tables:*",
        "rig.estimate.search.inputs:*",
        "rig.estimate.search.prepare:*",
        "rig.estimate.search.stream:*",
    ),
    "rows of a simulated scene, whose light test_light.py holds": (
        "tests/unit/rig/tradeoff/test_scene_limits.py",
        "rig.tradeoff.row_light:*",
    ),
    "labels around the best position, against the likelihood itself": (
        "tests/unit/rig/estimate/search/test_closeup.py",
        "rig.estimate.search.closeup:*",
    ),
    "bytes that stop at 255, against whole numbers": (
        "tests/unit/rig/estimate/joint/test_paths.py",
        "rig.estimate.joint.paths:*",
        "rig.estimate.joint.winner:*",
        "rig.estimate.joint.vote:*",
    ),
    "costs of labels against log-likelihoods; any rays and windows in test_estimators.py": (
        "tests/unit/rig/estimate/joint/test_label_volume.py",
        "rig.estimate.joint.labels.grid:*",
        "rig.estimate.joint.labels.tables:*",
        "rig.estimate.joint.labels.costs:*",
        "rig.estimate.joint.labels.cost_rows:*",
    ),
    "light around the stripe, against costs written out": (
        "tests/unit/rig/estimate/joint/test_halo.py",
        "rig.estimate.joint.halo:*",
        "rig.estimate.joint.labels.halo_rows:*",
        "rig.estimate.row.inputs:*",
    ),
    "answers of whole maps; those to any counts in test_estimators.py": (
        "tests/unit/rig/estimate/joint/test_joint.py",
        "rig.estimate.joint.confidence:*",
        "rig.estimate.joint.lesson:*",
    ),
    "trust of any light, margin and sd": (
        "tests/unit/rig/estimate/joint/test_lesson.py",
        "rig.estimate.joint.lesson:*",
    ),
    "places pooled over walls and neighbours; those of any counts in test_estimators.py": (
        "tests/unit/rig/estimate/joint/test_place.py",
        "rig.estimate.joint.place.light:*",
        "rig.estimate.joint.place.score:*",
        "rig.estimate.joint.place.pool:*",
        "rig.estimate.joint.place.place:*",
        "rig.estimate.joint.place.places:*",
    ),
    "which maps teach": (
        "tests/unit/rig/estimate/search/test_online_learning.py",
        "rig.estimate.search.online_learning:*",
    ),
    "what the last map says": (
        "tests/unit/rig/estimate/joint/test_temporal.py",
        "rig.estimate.joint.temporal:*",
    ),
    "columns of several lines, counted as of each alone": (
        "tests/unit/rig/count/test_line_counter.py",
        "rig.geometry.line_grid:*",
        "rig.count.line_counter:*",
    ),
    "what a link carries, and what is said of a scan that asks for more": (
        "tests/unit/rig/plan/test_moving_windows.py",
        "rig.plan.describe:*",
    ),
    "which calibrations a plan refuses; those of any speed in test_plans.py": (
        "tests/unit/rig/plan/test_compile.py",
        "rig.plan.calibration_reach:model_problems",
    ),
    "lines by the number, as the config says": ("tests/unit/rig/config/test_models.py",),
    "sheets, in one kernel; those of any numbers in test_calibration_model.py": (
        "tests/unit/rig/geometry/test_bent_light.py",
        "rig.geometry.bent_light:*",
        "rig.geometry.kernels:*",
    ),
    "boards, their drawings and corners; pictures of anything in test_calibration_data.py": (
        "tests/unit/calibration/test_detection.py",
        "calibration.board.board:*",
        "calibration.board.drawing:*",
        "calibration.board.detect:*",
        "calibration.board.markers:*",
        "calibration.board.lattice:*",
        "calibration.board.registration:*",
        "calibration.views:*",
    ),
    "steps of the camera's fit; whole fits of any views in test_calibration_data.py": (
        "tests/unit/calibration/test_camera_fit.py",
        "calibration.camera_fit:*",
        "calibration.diagnosis.camera:*",
    ),
    "steps from counts to passages; any counts in test_calibration_data.py": (
        "tests/unit/calibration/test_passages.py",
        "calibration.passages.light:*",
        "calibration.passages.fit:*",
        "calibration.passages.find:*",
        "calibration.passages.flux_picture:*",
        "calibration.sync.shared_pixels:*",
    ),
    "steps of the whole fit; whole fits of any views in test_calibration_data.py": (
        "tests/unit/calibration/test_rig_fit.py",
        "calibration.rig_fit.start:*",
        "calibration.rig_fit.rows:*",
        "calibration.rig_fit.solve:*",
        "calibration.rig_fit.state:*",
        "calibration.rig_fit.noise:*",
        "calibration.rig_fit.misfit:*",
        "calibration.rig_fit.result:*",
        "calibration.rig_fit.fit:*",
    ),
    "lags and delays against drawn passages": (
        "tests/unit/calibration/test_sync_fit.py",
        "calibration.sync.lag_fit:*",
        "calibration.sync.gate_fit:*",
    ),
    "which lags sweeps tell, against sweeps and fits of them": (
        "tests/unit/calibration/test_lags.py",
        "calibration.model.parameters:*",
        "calibration.diagnosis.rules:*",
        "calibration.sync.transfer:*",
    ),
    "boards at known places, scanned": (
        "tests/unit/calibration/test_check_fit.py",
        "calibration.check:*",
        "calibration.diagnosis.camera:*",
        "calibration.depth_error:*",
    ),
    "mistakes made on purpose, each by its own number": (
        "tests/unit/calibration/test_verdict.py",
        "calibration.diagnosis.evidence:*",
        "calibration.verdict:*",
        "calibration.diagnosis.rig:*",
        "calibration.diagnosis.view_shifts:*",
        "calibration.depth_error:*",
    ),
    "poses to show next": (
        "tests/unit/calibration/test_guide.py",
        "calibration.guide:*",
    ),
    "rates drawn from a measured distribution": (
        "tests/unit/calibration/test_pixels.py",
        "calibration.pixel_map:*",
        "calibration.views:*",
    ),
    "numbers in words": (
        "tests/unit/calibration/test_digits.py",
        "calibration.errors:*",
    ),
    "words of a file": (
        "tests/unit/calibration/test_model_files.py",
        "calibration.files.sections:*",
        "calibration.files.problems:*",
    ),
    "rays and surfaces put together; their light in test_light.py": (
        "tests/unit/sim/test_scene.py",
        "sim_backend.light.view:make_view",
    ),
    "intervals against drawn repeats": (
        "tests/unit/rig/tradeoff/test_intervals.py",
        "rig.tradeoff.rows:*",
    ),
    "a missing answer's charge": (
        "tests/unit/rig/tradeoff/test_tradeoff.py",
        "rig.tradeoff.rows:*",
    ),
    "powers of two off the bits of a number": ("tests/unit/rig/simd/test_powers.py",),
    "the search, column by column: the same bits": (
        "tests/unit/rig/estimate/search/test_stream.py",
        "rig.estimate.search.stream:*",
        "rig.estimate.likelihood:*",
    ),
    "which lines are read and how they are weighted": (
        "tests/unit/rig/estimate/row/test_em.py",
        "rig.estimate.row.em:*",
        "rig.estimate.row.em_kernels:*",
        "rig.estimate.row.model:RowModel.*",
    ),
    "rows as the kernels read them; any rays and windows in test_estimators.py": (
        "tests/stability/test_estimators.py",
        "rig.estimate.row.inputs:*",
        "rig.estimate.registry:*",
        "rig.estimate.joint.second_returns:*",
        "rig.estimate.joint.second_return_blocks:*",
    ),
    "against 50 digits, for kernels only": (
        "tests/stability/test_photon_bits.py",
        "sim_backend.random_numbers:*",
    ),
    "statistics of the bits": (
        "tests/unit/sim/test_photons.py",
        "sim_backend.frames.photon_kernels:*",
        "sim_backend.frames.photons:*",
    ),
    "what a scene file says, validated with units": (
        "tests/unit/sim/test_scene.py",
        "sim_backend.scenes.scene:*",
        "sim_backend.scenes.medium:Medium.*",
    ),
    "sizes and speeds of drops and flakes, against their sources": (
        "tests/unit/sim/test_weather.py",
        "sim_backend.scenes.medium:*",
    ),
    "particles, one by one; any scene's light in test_light.py": (
        "tests/unit/sim/test_particles.py",
        "sim_backend.effects.particles:*",
    ),
    "surfaces that move": (
        "tests/unit/sim/test_motion.py",
        "sim_backend.effects.motion:*",
    ),
    "grains": (
        "tests/unit/sim/test_speckle.py",
        "sim_backend.effects.speckle:*",
    ),
    "widths of the line": (
        "tests/unit/sim/test_line_width.py",
        "sim_backend.light.line:*",
    ),
    "light of the row and its spread; closed forms in test_light.py": (
        "tests/unit/sim/test_stripe.py",
        "sim_backend.effects.stripe:*",
    ),
    "a fit to path tracing": (
        "tests/unit/sim/test_halo.py",
        "sim_backend.effects.halo:*",
    ),
    "a measured distribution": (
        "tests/unit/sim/test_dark_counts.py",
        "sim_backend.effects.dark_counts:*",
    ),
    "the mirror's random error": (
        "tests/unit/sim/test_jitter.py",
        "sim_backend.mirror_motion:Jitter.*",
    ),
    "what sensors make of bits: statistics against closed forms": (
        "tests/unit/sim/test_sensor_bits.py",
        "sim_backend.effects.afterpulsing:*",
        "sim_backend.effects.bit_errors:*",
        "sim_backend.effects.crosstalk:*",
        "sim_backend.effects.defects:*",
        "sim_backend.effects.rare_bits:*",
        "sim_backend.effects.setting:*",
    ),
    "waits on the host's clock": (
        "tests/unit/drivers/test_clock.py",
        "drivers.clock:SystemClock.*",
        "drivers.replay.pace:Pace.wait_for_step",
    ),
}
"""Why a function has no test here: the test that holds it, then the functions."""


def test_every_public_numeric_function_is_held_to_its_domain() -> None:
    excused = {pattern for _, *patterns in ELSEWHERE.values() for pattern in patterns}
    patterns = covered() | excused
    missing = [name for name in public_functions() if not any(fnmatchcase(name, p) for p in patterns)]
    assert not missing, f"cover these in tests/stability, or excuse them in {__name__}: {missing}"


def test_nothing_is_listed_that_is_not_there() -> None:
    names = list(public_functions())
    patterns = covered() | {pattern for _, *patterns in ELSEWHERE.values() for pattern in patterns}
    assert not [p for p in sorted(patterns) if not any(fnmatchcase(name, p) for name in names)]
    assert not [file for file, *_ in ELSEWHERE.values() if not (ROOT / file).is_file()]
