"""One trial: a setting by chance, an input with one thing wrong, and what the program makes of it."""

import tempfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import DeviceError
from rig.errors import RigError
from tests.campaigns.wrong_inputs.inputs import CASES
from tests.campaigns.wrong_inputs.setting import OFF, WORSE, Setting, depths, off, truths


def case(name: str, seed: int) -> dict[str, Any]:
    """The trial of this number of a case of `CASES`, in plain values.

    setting: what was drawn. what: what is wrong. off: largest relative depth error of a map at its median, None without
    depth. undisturbed: the same without the wrong input, and undisturbed_doubted: whether that is not complete, if
    `off` is more than OFF; else None. wrong: whether `off` is more than
    OFF, and more than WORSE times that. verdict: of the run, or 'error'. reasons: of the verdict, or the error's lines.
    caught: whether verdict or error say that something is wrong.
    """
    wanted = CASES[name]
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    with tempfile.TemporaryDirectory(prefix="wrong-") as folder:
        setting = Setting.drawn(rng, Path(folder), maps=wanted.maps, fewest=wanted.fewest, pixels=wanted.pixels)
        wrong, usual, doubted = wanted.make(setting), None, None
        try:
            summary = wrong.run().summary
            verdict, reasons = str(summary.verdict), [each.reason for each in summary.verdict_reasons]
            error = off(depths(setting.folder / "depth"), *wrong.true)
            if error is not None and error > OFF:
                run = wrong.undisturbed()
                doubted = str(setting.depth(run, "undisturbed").summary.verdict) != "complete"
                usual = off(depths(setting.folder / "undisturbed"), truths(run))
        except (RigError, DeviceError) as refused:
            verdict, reasons, error = "error", str(refused).splitlines(), None
    return {
        "case": name,
        "seed": seed,
        "setting": setting.told(),
        "what": wrong.what,
        "off": error,
        "wrong": error is not None and error > OFF and (usual is None or error > WORSE * usual),
        "undisturbed": usual,
        "undisturbed_doubted": doubted,
        "verdict": verdict,
        "reasons": reasons,
        "caught": verdict != "complete" or bool(reasons),
    }
