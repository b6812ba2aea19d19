"""The figures of `rig align`: the line's width from rows of counts, rates and saturation, power, and its ends."""

import json
import math
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import DeviceFault
from drivers.interfaces import LineLaser
from rig import api
from rig.calibrate.align import AlignFigures, Alignment, LineLook, line_width_px, row_rates
from rig.count.volume import CountVolume
from rig.errors import DevicesError, UsageError
from rig.geometry.stripe_table import StripeTable
from rig.live.slot import SlotReader, Value
from tests.system.small_rig import HEIGHT, WIDTH, emulated, write_rig

ROWS = 2304
FWHM = 2 * math.sqrt(2 * math.log(2))


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def line(sigma_px: float, exposures: int, peak: float, level: float, seed: int = 0, pixels: int = 512) -> np.ndarray:
    """Rates in rows with a Gaussian line at random places over a level of other light."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform(0.15 * pixels, 0.85 * pixels, (ROWS, 1))
    flux = -math.log1p(-peak) * np.exp(-0.5 * ((np.arange(pixels) - centre) / sigma_px) ** 2) + level
    return rng.binomial(exposures, -np.expm1(-flux)) / exposures


@pytest.mark.parametrize("exposures", [4, 10])
@pytest.mark.parametrize("sigma_px", [0.8, 1.5, 3.0, 6.0])
def test_the_width_is_that_of_the_line_in_and_out_of_focus(sigma_px: float, exposures: int) -> None:
    width = line_width_px(line(sigma_px, exposures, 0.2, 0.01))
    assert width == pytest.approx(FWHM * sigma_px, rel=0.12)


def test_hot_pixels_and_a_bright_room_do_not_change_the_width() -> None:
    rates = line(1.5, 10, 0.3, 0.05)
    rates[:, [77, 300, 410]] = 1.0
    clean = line_width_px(line(1.5, 10, 0.3, 0.05))
    assert line_width_px(rates) == pytest.approx(clean, rel=0.1)


def test_a_line_much_narrower_than_a_pixel_has_the_width_of_one() -> None:
    rng = np.random.default_rng(1)
    at = rng.uniform(50, 450, ROWS)
    rates = np.zeros((ROWS, 512))
    rates[np.arange(ROWS), at.astype(int)] = 1 - at % 1
    rates[np.arange(ROWS), at.astype(int) + 1] = at % 1
    assert line_width_px(rates) == pytest.approx(1.0, abs=0.4)


@pytest.mark.parametrize("level", [0.0, 0.02, 0.5])
def test_without_a_line_there_is_no_width(level: float) -> None:
    rng = np.random.default_rng(3)
    assert [line_width_px(rng.binomial(3, level, (ROWS, 512)) / 3) for _ in range(5)] == 5 * [None]
    assert line_width_px(np.zeros((10, 12))) is None, "too short for a level without a line"


def volume(counts: np.ndarray, x0: np.ndarray, exposures: int, width: int) -> CountVolume:
    columns = len(counts)
    return CountVolume(
        counts=counts.astype(np.uint8), x0=x0.astype(np.int32), exposures=exposures, width=width,
        n_frames=np.full(columns, exposures, np.int32), column=np.arange(columns, dtype=float), dark_counts=None,
        n_dark=0,
    )  # fmt: skip


def test_rates_lie_where_the_windows_are() -> None:
    counts = np.zeros((2, 3, 64))
    counts[0, 1, 5], counts[1, 2, 63] = 4, 2
    rates = row_rates(volume(counts, np.array([0, 64]), 4, 128)).reshape(2, 3, 128)
    assert rates[0, 1, 5] == 1.0
    assert rates[1, 2, 127] == 0.5
    assert rates.sum() == 1.5


def test_saturated_and_sure_stripes_are_counted_by_their_brightest_pixel() -> None:
    counts = np.zeros((4, 2, 64))
    counts[:, :, 20] = [[10, 9], [8, 10], [1, 1], [0, 0]]
    stripe = StripeTable.empty(2, 4)
    stripe.x_px[:] = 20.3
    stripe.confidence[:, :2], stripe.confidence[:, 2] = 0.99, 0.5
    look = LineLook.of(7, volume(counts, np.zeros(4), 10, 64), stripe)
    figures = look.figures(0.005, 0.05, 0.01, lost=3)
    assert figures.line_seen == 0.5
    assert figures.saturated_fraction == 0.75
    assert figures.peak_rate == pytest.approx(0.95)
    assert figures.scan_peak_rate == pytest.approx(1 - 0.05**2), "at twice the power"
    assert figures.mean_rate == pytest.approx(counts.sum() / 10 / counts.size)
    assert look.profile[20] == pytest.approx(counts.sum() / 40 / 2)
    assert (figures.sweeps, figures.lost) == (7, 3)


def figures(**changes: float | None) -> AlignFigures:
    content: dict[str, float | None] = {
        "sweeps": 3, "power_w": 0.005, "limit_w": 0.05, "focus_px": 2.0, "left_px": None, "middle_px": 2.0,
        "right_px": 2.1, "line_seen": 0.5, "peak_rate": 0.4, "scan_peak_rate": 0.99, "saturated_fraction": 0.01,
        "mean_rate": 0.01,
    }  # fmt: skip
    return AlignFigures(**(content | changes))  # type: ignore[arg-type]


def test_the_line_for_people_says_what_is_there() -> None:
    assert figures().line == (
        "sweep 3: line 2.00 px wide (left -, middle 2.00, right 2.10), seen at 50%, peak rate 0.40, in a scan 0.99, "
        "1.0% saturated, mean rate 0.01"
    )
    dark = figures(focus_px=None, peak_rate=None, scan_peak_rate=None, saturated_fraction=None, line_seen=0.0, lost=2)
    assert dark.line == "sweep 3: no line stands out, seen at 0%, mean rate 0.01, 2 frames lost"


def test_an_alignment_says_whether_it_saw_a_line() -> None:
    assert Alignment("lab", figures()).as_json()["verdict"] == "line"
    assert Alignment("lab", figures(focus_px=None)).as_json()["verdict"] == "no line"
    assert Alignment("lab", None).as_json() == {"config": "lab", "verdict": "aborted"}


def test_a_simulated_rig_is_aligned_at_a_tenth_of_its_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    powers: list[float] = []
    arm = LineLaser.arm
    monkeypatch.setattr(LineLaser, "arm", lambda self, power_w: (powers.append(power_w), arm(self, power_w))[1])
    begun: list[tuple[float, float]] = []
    told: list[AlignFigures] = []
    small = write_rig(tmp_path / "small")
    found = api.align(small, seconds=0.01, begun=lambda *powers: begun.append(powers), tell=told.append)
    assert found.found
    assert found.last is not None
    assert powers == [pytest.approx(0.1 * begun[0][1])]
    assert found.last.power_w == powers[0]
    assert 1.0 < (found.last.focus_px or 0.0) < 4.0
    assert told[0].sweeps >= 1


def test_the_page_gets_figures_profile_and_sum_image(tmp_path: Path) -> None:
    values: dict[str, Value] = {}
    ended = threading.Event()

    def watch() -> None:
        while (slot := SlotReader.newest()) is None:
            time.sleep(0.005)
        with SlotReader.open(slot.path) as reader:
            while reader.alive:
                reader.touch()
                for section in ("setup", "figures", "map"):
                    if (value := reader.read(section)) is not None:
                        values[section] = value
                if len(values) == 3:
                    reader.request_stop()
                time.sleep(0.01)
        ended.set()

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    # On a thread, so that the stop does not interrupt the tests.
    aligned: list[Alignment] = []
    work = threading.Thread(target=lambda: aligned.append(api.align(write_rig(tmp_path / "small"))))
    work.start()
    work.join(120)
    assert ended.wait(10)
    assert aligned[0].last is not None
    assert values["setup"].header["kind"] == "align"
    assert values["setup"].header["maps"] is None
    assert values["figures"].arrays["profile"].shape == (WIDTH,)
    assert values["figures"].header["power_w"] == aligned[0].last.power_w
    assert values["map"].arrays["intensity"].shape == (HEIGHT, WIDTH)
    assert values["map"].arrays["intensity"].any()


@pytest.mark.parametrize("interrupted", [False, True])
def test_a_laser_that_does_not_go_off_at_once_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, interrupted: bool
) -> None:
    pause, failures = LineLaser.pause, [DeviceFault("it does not answer")]

    def stuck(self: LineLaser) -> None:
        if failures:  # the laser's close pauses it again
            raise failures.pop()
        pause(self)

    def interrupt(figures: AlignFigures) -> None:
        if interrupted:
            raise KeyboardInterrupt

    monkeypatch.setattr(LineLaser, "pause", stuck)
    with pytest.raises(DevicesError, match="laser: it does not answer"):
        api.align(write_rig(tmp_path / "small"), seconds=0.01, tell=interrupt)


def test_emulated_wires_are_aligned_too(tmp_path: Path) -> None:
    found = api.align(write_rig(tmp_path / "wires", emulated()), seconds=0.01, power="10 mW")
    assert found.found
    assert found.last is not None
    assert found.last.power_w == pytest.approx(0.01)


def test_no_light_no_line(tmp_path: Path) -> None:
    found = api.align(write_rig(tmp_path / "dark"), seconds=0.01, power="0.000001 mW")
    assert found.as_json()["verdict"] == "no line"
    json.dumps(found.as_json(), allow_nan=False)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"power": "200 mW"}, r"`power` is 200 mW; .* may be given 0 to 100 mW"),
        ({"power": "5"}, "`power` '5'"),
        ({"seconds": 0}, "seconds is 0; it must be above 0"),
        ({"seed": -1}, "seed is -1"),
    ],
)
def test_mistakes_are_refused_before_anything_moves(tmp_path: Path, changes: dict[str, object], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        api.align(write_rig(tmp_path / "small"), **changes)


def test_a_real_laser_needs_consent() -> None:
    with pytest.raises(UsageError, match=r"real light .* `arm=True`"):
        api.align("lab")
