"""Every public numeric function is taken through its domain by a test of this folder, or excused with a reason."""

from fnmatch import fnmatchcase

from tests.stability.inventory import ROOT, covered, public_functions

ELSEWHERE = {
    "exact whole numbers, against unpacked sums": (
        "tests/unit/rig/test_counting_kernels.py", "rig.counting_kernels:*",
    ),
    "columns from the frame number, exactly": ("tests/unit/rig/test_cube.py", "rig.cube:*"),
    "what a sweep is made of, frame by frame": (
        "tests/unit/rig/test_binding.py", "rig.binding_kernels:cover", "rig.sweeps:*",
    ),
    "places and numbers that the light gives, with the patterns of test_plans.py": (
        "tests/unit/rig/test_blanking.py", "rig.blanking_sync:*",
    ),
    "asks the search of test_plans.py again": ("tests/unit/rig/test_plan.py", "rig.path_search:remedy"),
    "whole-number tables and lanes of the compiled search; its answers for any counts in test_estimators.py": (
        "tests/unit/estimators/test_search.py", "rig.estimators.best_kernels:*", "rig.estimators.row_search:*",
        "rig.estimators.screen_tables:*", "rig.estimators.search_*:*", "rig.estimators.judging:*",
        "rig.estimators.volume_search:*",
    ),
    "rows of a simulated scene, whose light test_light.py holds": (
        "tests/unit/rig/test_scene_limits.py", "rig.scene_limits:*",
    ),
    "labels around the best position, against the likelihood itself": (
        "tests/unit/estimators/test_closeup.py", "rig.estimators.closeup_kernels:*",
    ),
    "bytes that stop at 255, against whole numbers": (
        "tests/unit/estimators/test_aggregation.py", "rig.estimators.aggregation_*:*",
    ),
    "costs of labels against log-likelihoods; any rays and windows in test_estimators.py": (
        "tests/unit/estimators/test_label_volume.py", "rig.estimators.label_places:*", "rig.estimators.label_tables:*",
        "rig.estimators.label_volume*:*",
    ),
    "light around the stripe, against costs written out": (
        "tests/unit/estimators/test_halo.py", "rig.estimators.halo*:*",
    ),
    "answers of whole maps; those to any counts in test_estimators.py": (
        "tests/unit/estimators/test_joint.py", "rig.estimators.joint_*:*",
    ),
    "trust of any light, margin and sd": (
        "tests/unit/estimators/test_joint_teaching.py", "rig.estimators.joint_teaching:*",
    ),
    "places pooled over walls and neighbours; those of any counts in test_estimators.py": (
        "tests/unit/estimators/test_placing.py", "rig.estimators.placing*:*",
    ),
    "which maps teach": ("tests/unit/estimators/test_lessons.py", "rig.estimators.lessons:*"),
    "what the last map says": ("tests/unit/estimators/test_temporal.py", "rig.estimators.temporal:*"),
    "columns of several lines, counted as of each alone": (
        "tests/unit/rig/test_multi_line.py", "rig.multi_line:*", "rig.multi_line_counter:*", "rig.multi_line_kernels:*",
    ),
    "what a link carries, and what is said of a scan that asks for more": (
        "tests/unit/rig/test_windows.py", "rig.frame_rates:*",
    ),
    "which calibrations a plan refuses; those of any speed in test_plans.py": (
        "tests/unit/rig/test_plan.py", "rig.calibration_reach:model_problems",
    ),
    "lines by the number, as the config says": ("tests/unit/rig/test_multi_line_config.py", "rig.multi_line_config:*"),
    "sheets, in one kernel; those of any numbers in test_calibration_model.py": (
        "tests/unit/rig/test_bent_light.py", "rig.bent_light:*", "rig.bent_light_kernels:*",
    ),
    "boards, their drawings and corners; pictures of anything in test_calibration_data.py": (
        "tests/unit/calibration/test_detection.py", "calibration.board.*:*", "calibration.views:*",
    ),
    "steps of the camera's fit; whole fits of any views in test_calibration_data.py": (
        "tests/unit/calibration/test_camera_fit.py", "calibration.camera_fit.*:*", "calibration.judging.camera:*",
    ),
    "steps from counts to passages; any counts in test_calibration_data.py": (
        "tests/unit/calibration/test_passages.py", "calibration.passages.*:*", "calibration.sync.shared_pixels:*",
    ),
    "steps of the whole fit; whole fits of any views in test_calibration_data.py": (
        "tests/unit/calibration/test_rig_fit.py", "calibration.rig_fit.*:*",
    ),
    "lags and delays against drawn passages": (
        "tests/unit/calibration/test_sync_fit.py", "calibration.sync.lag_fit:*", "calibration.sync.gate_fit:*",
    ),
    "which lags sweeps tell, against sweeps and fits of them": (
        "tests/unit/calibration/test_lags.py", "calibration.model.lag_speeds:*", "calibration.judging.lags:*",
        "calibration.sync.transfer:*",
    ),
    "boards at known places, scanned": (
        "tests/unit/calibration/test_check_fit.py", "calibration.check.*:*", "calibration.judging.check:*",
        "calibration.depth.propagation:*",
    ),
    "mistakes made on purpose, each by its own number": (
        "tests/unit/calibration/test_verdict.py", "calibration.judging.data_lack:*", "calibration.verdict:*",
        "calibration.judging.evidence:*", "calibration.judging.rig:*", "calibration.judging.view_shifts:*",
        "calibration.depth.sensitivity:*", "calibration.depth.against_truth:*",
    ),
    "poses to show next": ("tests/unit/calibration/test_guide.py", "calibration.guide.poses:*"),
    "rates drawn from a measured distribution": (
        "tests/unit/calibration/test_pixels.py", "calibration.pixels.pixel_map:*", "calibration.pixels.dark_tally:*",
        "calibration.robust:*",
    ),
    "numbers in words": ("tests/unit/calibration/test_digits.py", "calibration.digits:*"),
    "words of a file": ("tests/unit/calibration/test_model_files.py", "calibration.files.*:*"),
    "rays and surfaces put together; their light in test_light.py": (
        "tests/unit/sim/test_scene.py", "sim_backend.view:make_view",
    ),
    "intervals against drawn repeats": ("tests/unit/rig/test_intervals.py", "rig.intervals:*"),
    "a missing answer's charge": ("tests/unit/rig/test_tradeoff.py", "rig.tradeoff_rows:*"),
    "powers of two off the bits of a number": ("tests/unit/estimators/test_powers.py", "rig.estimators.powers:*"),
    "the search, column by column: the same bits": (
        "tests/unit/estimators/test_stream.py", "rig.estimators.stream*:*", "rig.estimators.likelihood:*",
    ),
    "which lines are read and how they are weighted": (
        "tests/unit/estimators/test_learning.py", "rig.estimators.learning:*",
        "rig.estimators.likelihood_kernels:*", "rig.estimators.row_model:RowModel.*",
    ),
    "rows as the kernels read them; any rays and windows in test_estimators.py": (
        "tests/stability/test_estimators.py", "rig.estimators.row_input:*", "rig.estimators:*",
        "rig.estimators.second_return*:*",
    ),
    "against 50 digits, for kernels only": ("tests/stability/test_photon_bits.py", "sim_backend.exponential:*"),
    "statistics of the bits": (
        "tests/unit/sim/test_photons.py", "sim_backend.photon_kernels:*", "sim_backend.photons:*",
    ),
    "what a scene file says, validated with units": (
        "tests/unit/sim/test_scene.py", "sim_backend.scene:*", "sim_backend.medium:Medium.*",
    ),
    "sizes and speeds of drops and flakes, against their sources": (
        "tests/unit/sim/test_weather.py", "sim_backend.weather:*",
    ),
    "particles, one by one; any scene's light in test_light.py": (
        "tests/unit/sim/test_particles.py", "sim_backend.effects.particle*:*",
    ),
    "surfaces that move": ("tests/unit/sim/test_motion.py", "sim_backend.effects.motion:*"),
    "grains": ("tests/unit/sim/test_speckle.py", "sim_backend.effects.speckle:*"),
    "widths of the line": ("tests/unit/sim/test_line_width.py", "sim_backend.line_width:*"),
    "light of the row and its spread; closed forms in test_light.py": (
        "tests/unit/sim/test_stripe.py", "sim_backend.effects.stripe:*",
    ),
    "a fit to path tracing": ("tests/unit/sim/test_halo.py", "sim_backend.effects.halo:*"),
    "a measured distribution": ("tests/unit/sim/test_dark_counts.py", "sim_backend.effects.dark_counts:*"),
    "the mirror's random error": ("tests/unit/sim/test_jitter.py", "sim_backend.mirror_motion:Jitter.*"),
    "what sensors make of bits: statistics against closed forms": (
        "tests/unit/sim/test_sensor_bits.py", "sim_backend.effects.afterpulsing:*", "sim_backend.effects.bit_errors:*",
        "sim_backend.effects.crosstalk:*", "sim_backend.effects.defects:*", "sim_backend.effects.rare_bits:*",
        "sim_backend.effects.setting:*",
    ),
    "waits on the host's clock": (
        "tests/unit/drivers/test_clock.py", "drivers.clock:SystemClock.*", "drivers.replay_pace:Pace.wait_for_step",
    ),
}  # fmt: skip
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
