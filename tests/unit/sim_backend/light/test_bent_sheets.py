"""Sheets that bow and rows that are late, as the simulated rig draws them, against light traced ray by ray."""

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest

from calibration.model.rig_model import RigModel
from sim_backend.effects.particles import rain_drops
from sim_backend.frames.flux import FluxModel
from sim_backend.frames.photons import PhotonSource
from sim_backend.light.line import ONE_LINE
from sim_backend.light.sheet import LightSheet
from sim_backend.world import DEFAULT_GEOMETRY
from tests.unit.calibration.fans import Fan
from tests.unit.sim_backend.rigs import deviations, drawn, made_world, rig, setting, wall

BOW, ROLL = 0.03, 0.08
COMMAND, LATER = 0.15, 0.02
"""Of the mirror while the first row is exposed, and by how much farther it is for the last."""
FOG = {"medium": {"extinction": "0.2 /m"}}


def bent(baseline_m: float = 0.3, bow: float = BOW) -> tuple[Fan, RigModel]:
    """A rig with a tilted axis and a bent lens, whose sheets bow; and its light to be traced."""
    model = rig(baseline_m=baseline_m, roll=ROLL, k1=-0.1)
    scanner = replace(model.scanner, bow_per_rad=bow)
    fan = Fan(scanner.axis_point_m, scanner.axis_direction, scanner.zero_normal, bow=bow, source=model.source_m)
    return fan, replace(model, scanner=scanner)


def traced(model: RigModel, held: np.ndarray) -> LightSheet:
    """The sheet on a slanted wall."""
    view = setting(model, wall(model, (0.3, -0.2, 1), 2.0)).view
    ((sheet,),) = ONE_LINE.sheets(model.sheets, held, view.rows, [0.0])
    view.trace(sheet, 0, 20)
    view.trace(sheet, 20, view.rows)
    return sheet


@pytest.mark.parametrize("baseline_m", [0.3, -0.3])
@pytest.mark.parametrize("later", [0.0, LATER])
def test_stripes_lie_where_the_traced_light_falls(baseline_m: float, later: float) -> None:
    fan, model = bent(baseline_m)
    command = COMMAND * np.sign(baseline_m)
    sheet = traced(model, np.array([[command, command + later]]))
    y = np.arange(0, 64, 7)
    x = sheet.x_stripe_px[y]
    assert np.isfinite(x).all()
    u, v = model.camera.tangents_at(x, y)
    points = np.stack([u, v, np.ones_like(u)], -1) * (2.0 / (0.3 * u - 0.2 * v + 1))[:, None]
    angle = model.scanner.angle_rad[1] * (command + later * y / 63)
    out_rad = np.array([fan.out_rad(a, p[None])[0] for a, p in zip(angle, points, strict=True)])
    assert np.abs(out_rad).max() * 110 < 2e-3  # pixels
    flat = traced(replace(model, scanner=replace(model.scanner, bow_per_rad=0.0)), np.array([command]))
    assert np.abs(flat.x_stripe_px[y] - x).max() > 0.2


def test_frames_have_the_light_of_late_rows_and_bowed_sheets() -> None:
    _, model = bent()
    setup = setting(model, wall(model, (0, 0, 1), 2.0), **FOG)
    flux, n = FluxModel(setup), 2000
    held = np.tile([COMMAND, COMMAND + LATER], (n, 1))
    bits = drawn(flux, model.sheets, held, 0.02)
    counts = np.unpackbits(bits, axis=-1)[:, :, :96].sum(axis=0, dtype=np.int64)
    ((sheet,),) = ONE_LINE.sheets(model.sheets, held[:1], 64, [0.0])
    setup.view.trace(sheet, 0, 64)
    rate = np.zeros((64, 96))
    flux.add_sheet(sheet, 0, 64, rate)
    flux_each = 1e-5 * (flux.steady_per_s + 0.02 * rate)
    z = deviations(counts, n, flux_each)
    assert np.abs(z).max() < 6
    assert np.std(z[flux_each > 0.01]) == pytest.approx(1, abs=0.06)
    assert flux_each.max() > 0.1


def test_drops_lie_on_the_sheet_that_their_row_sees() -> None:
    _, model = bent(bow=0.0)
    setup = setting(model, wall(model, (0, 0, 1), 2.0), rain={"rate": "50 mm/h"})
    effect, first = rain_drops(setup), traced(model, np.array([COMMAND]))
    late = traced(model, np.array([[COMMAND, COMMAND]]))
    alike, of_rows = np.zeros((64, 96)), np.zeros((64, 96))
    effect.add(first, 0, 64, alike)
    effect.add(late, 0, 64, of_rows)
    assert alike.any()
    np.testing.assert_allclose(of_rows, alike, rtol=1e-9)  # rows that are not late after all
    moved = np.zeros((64, 96))
    effect.add(traced(model, np.array([[COMMAND, COMMAND + 0.3]])), 0, 64, moved)
    assert not np.allclose(moved[32:], alike[32:])


def test_the_world_says_that_light_is_bent_and_where_late_rows_see_it(tmp_path) -> None:
    file = tmp_path / "rig.yaml"
    text = DEFAULT_GEOMETRY.read_text()
    file.write_text(
        text.replace("    command_range:", "    bow_per_rad: 0.01\n    command_range:") + "row_delay_s: 2e-8\n"
    )
    world, plain = (made_world(geometry=str(of)) for of in (file, DEFAULT_GEOMETRY))
    on, plain_on = ({d.entry.name for d in of.effect_plan.decisions if d.on} for of in (world, plain))
    assert on - plain_on == {"sheet bow", "row delay"}
    assert plain_on < on
    assert "20 ns" in world.setting.devices["row delay"]
    assert world.true_model().row_delay_s == 2e-8
    commands = np.array([0.0, 0.2])
    up, down = (world.truth(commands, velocity).x_px for velocity in (200.0, -200.0))
    # 511 rows of 20 ns at 200 a second are 2e-3 of the command, half a pixel and more.
    assert np.nanmedian((up - down)[500:]) == pytest.approx(2 * 2e-3 * 0.5315 * 600, rel=0.3)
    assert np.nanmax(np.abs(up - down)[0]) < 1e-6
    assert np.array_equal(plain.truth(commands, 200.0).x_px, plain.truth(commands).x_px, equal_nan=True)


def test_drops_in_bowed_light_do_not_depend_on_which_band_of_rows_is_drawn_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, model = bent(bow=0.1)
    flux = FluxModel(setting(model, wall(model, (0, 0, 1), 2.0), rain={"rate": "50 mm/h"}))
    held = np.linspace(-0.3, 0.3, 40)

    def last_band_first(self: PhotonSource, jobs: Iterable[Callable[[], None]]) -> None:
        for job in reversed(list(jobs)):
            job()

    before = drawn(flux, model.sheets, held, 50.0, threads=1)
    monkeypatch.setattr(PhotonSource, "_each", last_band_first)
    assert np.array_equal(drawn(flux, model.sheets, held, 50.0, threads=4), before)
