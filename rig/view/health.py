"""Figures of a run for the page: a name, a value in words, and whether it needs attention."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

GOOD: Final = ""
WARN: Final = "warn"
BAD: Final = "bad"
RING_FULL: Final = 0.9
"""Share of the ring's slots in use above which frames may soon find no room."""
LEAST_FREE_BYTES: Final = 10e9
"""Free space below which a recording may soon end: a minute at 170 MB/s."""


MOST_SATURATED: Final = 0.01
"""Share of the line above which saturation blurs it."""


class Figure(NamedTuple):
    """One line of the page. level: GOOD, WARN or BAD."""

    name: str
    value: str
    level: str = GOOD


def of_status(status: Mapping[str, Any]) -> list[Figure]:
    """Figures of a running scan, from the header of the section `status`."""
    return [figure for part in (_progress, _ring, _disk, _laser, _temperatures, _doubts) for figure in part(status)]


def of_summary(summary: Mapping[str, Any], manifest: Mapping[str, Any]) -> list[Figure]:
    """Figures of a finished run, from its summary and manifest; either may be empty."""
    figures: list[Figure] = []
    verdict = summary.get("verdict") or manifest.get("verdict")
    if verdict:
        figures.append(Figure("verdict", str(verdict), GOOD if verdict == "complete" else BAD))
    for reason in summary.get("verdict_reasons") or ():
        numbers = ", ".join(map(str, reason.get("maps") or ()))
        figures.append(Figure("doubt", f"{reason.get('reason')} (maps {numbers})", BAD))
    if frames := summary.get("frames"):
        lost = int(frames.get("lost") or 0)
        figures.append(Figure("frames", f"{_whole(frames.get('received'))} of {_whole(frames.get('expected'))}"))
        gaps = len(manifest.get("gaps") or ())
        figures.append(_lost(lost, gaps))
    if summary.get("maps") is not None:
        rate = summary.get("map_rate_hz")
        figures.append(
            Figure("maps", _whole(summary["maps"]) + ("" if rate is None else f", {rate:.3g} a second of sensor time"))
        )
    if summary.get("valid_fraction") is not None:
        figures.append(Figure("filled", f"{summary['valid_fraction']:.1%} of the pixels"))
    if stages := summary.get("stages"):
        dropped = int(stages.get("dropped_frames") or 0)
        ring = f"at most {stages.get('ring_high_water')} of {stages.get('ring_slots')} blocks"
        figures.append(Figure("ring", ring + (f", {_whole(dropped)} frames dropped" if dropped else ""), _bad(dropped)))
    recording = manifest.get("recording") or {}
    if recording.get("bytes"):
        figures.append(Figure("disk", f"{_bytes(recording['bytes'])} recorded", _bad(recording.get("failed"))))
    laser = (manifest.get("devices") or {}).get("laser") or {}
    if laser.get("name"):
        figures.append(Figure("laser", str(laser["name"])))
    for name, label in (("estimator", "estimator"), ("exposures", "exposures"), ("columns", "columns")):
        if summary.get(name) is not None:
            figures.append(Figure(label, str(summary[name])))
    taken = (manifest.get("rig") or {}).get("taken")
    return [*figures, *([Figure("taken", str(taken))] if taken else [])]


def of_alignment(figures: Mapping[str, Any]) -> list[Figure]:
    """Figures of an alignment, from the header of the section `figures`: those of `AlignFigures`, of rig align."""
    width, seen, mean = (figures.get(name) for name in ("focus_px", "line_seen", "mean_rate"))
    peak, in_scan, saturated = (figures.get(name) for name in ("peak_rate", "scan_peak_rate", "saturated_fraction"))
    parts = ((name, figures.get(f"{name}_px")) for name in ("left", "middle", "right"))
    thirds = ", ".join(f"{name} {'none' if px is None else f'{px:.2f}'}" for name, px in parts)
    told = [Figure("line width", f"{width:.2f} px ({thirds})" if width else "no line stands out", _bad(not width))]
    if seen is not None:
        told.append(Figure("line seen", f"{seen:.0%} of rows and columns"))
    if peak is not None:
        later = "" if in_scan is None else f", in a scan {in_scan:.2f}"
        told.append(Figure("peak rate", f"{peak:.2f} per exposure{later}"))
    if saturated is not None:
        told.append(Figure("saturated", f"{saturated:.1%} of the line", WARN if saturated > MOST_SATURATED else GOOD))
    if mean is not None:
        told.append(Figure("mean rate", f"{mean:.2g} per exposure and pixel"))
    if figures.get("power_w") is not None and figures.get("limit_w") is not None:
        told.append(Figure("laser power", f"{figures['power_w'] * 1e3:g} of {figures['limit_w'] * 1e3:g} mW"))
    return told


def fog_of(fog: Mapping[str, Any] | None) -> dict[str, float] | None:
    """Extinction and visibility with their standard deviations, for the meter; None if there is no reading."""
    if not fog or fog.get("extinction_per_m") is None:
        return None
    names = ("extinction_per_m", "extinction_sd_per_m", "visibility_m", "visibility_sd_m")
    return {name: float(fog[name]) for name in names if fog.get(name) is not None}


def _progress(status: Mapping[str, Any]) -> Iterator[Figure]:
    yield Figure("stage", str(status.get("stage") or "unknown"))
    planned = status.get("frames_planned")
    yield Figure("frames", _whole(status.get("frames")) + (f" of {_whole(planned)}" if planned else ""))
    yield _lost(int(status.get("lost") or 0), int(status.get("gaps") or 0))
    rate, planned = status.get("map_rate_hz"), status.get("maps")
    counted = _whole(status.get("sweeps")) + (f" of {_whole(planned)}" if planned else "")
    yield Figure("maps", counted + (f", {rate:.3g} a second" if rate else ""))


def _ring(status: Mapping[str, Any]) -> Iterator[Figure]:
    ring = status.get("ring")
    if not ring:
        return
    fill, dropped = float(ring.get("fill") or 0.0), int(ring.get("dropped_frames") or 0)
    said = f"{fill:.0%} full, at most {ring.get('high_water')} of {ring.get('slots')} blocks"
    said += f", {_whole(dropped)} frames dropped" if dropped else ""
    yield Figure("ring", said, BAD if dropped else WARN if fill >= RING_FULL and not ring.get("waits") else GOOD)


def _disk(status: Mapping[str, Any]) -> Iterator[Figure]:
    disk = status.get("disk")
    if not disk:
        return
    free = disk.get("free_bytes")
    said = f"{_bytes(disk.get('written_bytes') or 0)} written"
    little = free is not None and free < LEAST_FREE_BYTES
    yield Figure("disk", said + ("" if free is None else f", {_bytes(free)} free"), WARN if little else GOOD)


def _laser(status: Mapping[str, Any]) -> Iterator[Figure]:
    laser = status.get("laser")
    if not laser:
        return
    fault, interlock = laser.get("fault"), laser.get("interlock_closed")
    said: list[str] = []
    if "armed" in laser:
        said.append("armed" if laser["armed"] else "not armed")
        said.append("emits while the gate is open" if laser.get("emission") else "dark")
    said += ["warming up"] if laser.get("warming_up") else []
    said += ["interlock open"] if interlock is False else []
    said += ["key off"] if laser.get("key_on") is False else []
    said += [f"{laser['power_w'] * 1e3:.3g} mW"] if laser.get("power_w") is not None else []
    said += [f"fault: {fault}"] if fault else []
    # Light is nothing wrong, but whoever looks must see it.
    level = BAD if fault or interlock is False else WARN if laser.get("emission") else GOOD
    yield Figure("laser", f"{laser.get('name') or 'laser'}: {', '.join(said) or 'has said nothing'}", level)


def _temperatures(status: Mapping[str, Any]) -> Iterator[Figure]:
    found: Mapping[str, float] = status.get("temperatures") or {}
    if found:
        yield Figure(
            "temperatures", ", ".join(f"{name} {celsius:.1f} \N{DEGREE SIGN}C" for name, celsius in found.items())
        )


def _doubts(status: Mapping[str, Any]) -> Iterator[Figure]:
    reasons: Sequence[str] = status.get("verdict_reasons") or ()
    yield from (Figure("doubt", str(reason), BAD) for reason in reasons)


def _lost(frames: int, gaps: int) -> Figure:
    said = f"{_whole(frames)} frames, {gaps} gaps in whole maps" if frames or gaps else "none"
    return Figure("lost", said, _bad(frames or gaps))


def _bad(value: Any) -> str:
    return BAD if value else GOOD


def _whole(value: Any) -> str:
    """A whole number with narrow gaps between thousands."""
    return "0" if value is None else f"{int(value):,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def _bytes(value: float) -> str:
    return f"{value / 1e9:.3g} GB" if value >= 1e9 else f"{value / 1e6:.3g} MB"
