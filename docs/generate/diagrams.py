"""Diagrams as SVG: one sweep over time, what can end the light, and small pictures."""

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from rig.plan.scan_plan import ScanPlan
from rig.report.charts import FAINT, GRID, INK

BLUE, ORANGE, GREEN, PINK = "#0072b2", "#d55e00", "#009e73", "#cc79a7"
_FONT = 'font-family="Helvetica, Arial, sans-serif" font-size="12"'


def svg(width: int, height: int, title: str, parts: Sequence[str]) -> str:
    """A whole file: a white sheet with a title and these elements."""
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}"',
            f"  {_FONT}>",
            f"<title>{escape(title)}</title>",
            f'<rect width="{width}" height="{height}" rx="8" fill="#ffffff"/>',
            text(14, 22, title, size=14, bold=True),
            *parts,
            "</svg>\n",
        ]
    )


def text(x: float, y: float, words: str, *, anchor: str = "start", size: int = 12, bold: bool = False,
         colour: str = INK) -> str:  # fmt: skip
    """Words at a place."""
    weight = ' font-weight="bold"' if bold else ""
    look = f'text-anchor="{anchor}" font-size="{size}"{weight} fill="{colour}"'
    return f'<text x="{x:.1f}" y="{y:.1f}" {look}>{escape(words)}</text>'


def sweep(plan: ScanPlan) -> str:
    """One sweep of a plan over time: the mirror's command and place, markers, gate, and the frames of each column."""
    left, right, top = 150, 850, 52
    leg, rate = plan.legs[0], float(plan.point_rate_hz)
    sweep_s = float(plan.sweep_s)

    def x(time_s: float) -> float:
        return left + (right - left) * time_s / sweep_s

    def level(command: float) -> float:
        return top + 100 - 45 * (command + 1)

    times = np.linspace(0, sweep_s, 200)
    commands = plan.command(times)
    late = plan.command(np.maximum(times - leg.lag_s, 0))
    parts = [
        _path([(x(t), level(c)) for t, c in zip(times, commands, strict=True)], FAINT, dashes="5 4"),
        _path([(x(t), level(c)) for t, c in zip(times, late, strict=True)], BLUE),
        text(14, top + 40, "mirror"), text(14, top + 56, "dashed: its command", size=11, colour=FAINT),
    ]  # fmt: skip
    scan_s = plan.waveform.markers & 2
    falls = float(np.flatnonzero(np.diff(scan_s.astype(int)) < 0)[0] + 1) / rate if scan_s.any() else sweep_s
    lines = [(point / rate, (point + 1) / rate) for point in plan.marker_points]
    rows = (
        ("scan marker", "begins each sweep", GREEN, [(0.0, falls)]),
        ("line markers", "the mirror is at a known place", GREEN, lines),
        ("gate", "laser light may come out", ORANGE, [(leg.gate_open_s, leg.gate_close_s)]),
    )  # fmt: skip
    at = top + 140.0
    for name, meaning, colour, spans in rows:
        parts += [_pulses([(x(a), x(b)) for a, b in spans], at, left, right, colour), text(14, at - 6, name)]
        parts.append(text(right + 14, at - 4, meaning, size=11, colour=FAINT))
        at += 34
    period = float(1 / plan.frame_rate_hz)
    middles = (np.arange(int(sweep_s / period)) + 0.5) * period
    columns = np.round(plan.column(middles, leg))
    for middle, column in zip(middles, columns, strict=True):
        lit = leg.gate_open_s <= middle <= leg.gate_close_s and 0 <= column < plan.columns
        colour = (BLUE if int(column) % 2 else PINK) if lit else GRID
        place = f'x="{x(middle - period / 2):.2f}" y="{at - 22:.1f}" width="{x(period) - left:.2f}" height="18"'
        parts.append(f'<rect {place} fill="{colour}"/>')
    for column in range(plan.columns):
        own = middles[(columns == column) & (middles >= leg.gate_open_s) & (middles <= leg.gate_close_s)]
        if own.size:
            parts.append(text(x(float(own.mean())), at + 10, str(column), anchor="middle", size=10))
    parts += [
        text(14, at - 8, "frames"), text(14, at + 10, "column", size=11, colour=FAINT),
        text(right + 14, at - 8, "grey: dark, or on the way", size=11, colour=FAINT),
        _path([(left, at + 22), (right, at + 22)], INK),
        *(text(x(ms / 1e3), at + 36, f"{ms:g}", anchor="middle", size=10) for ms in np.arange(0, sweep_s * 1e3, 0.5)),
        text(right + 14, at + 36, "ms after the scan marker", size=11),
    ]  # fmt: skip
    return svg(1040, int(at + 52), f"One sweep: {plan.columns} columns of {plan.exposures} frames", parts)


def light_chain() -> str:
    """What the light passes from the laser to the scene, and who can end it."""
    parts = []
    chain = (
        (20, "laser", "key, interlock,", "emission on"),
        (230, "gate", "digital modulation,", "pull-down: dark"),
        (440, "mirror", "moves while", "the gate is high"),
        (650, "scene", "beam path clear", "(--arm)"),
    )
    for i, (left, name, first, second) in enumerate(chain):
        parts.append(_box(left, 60, 150, 66, name, (first, second), ORANGE if i < 2 else GRID))
        if i < len(chain) - 1:
            parts.append(_arrow((left + 150, 93), (left + 210, 93), ORANGE))
    below = (
        (20, "room interlock", ("hardware, not this", "program"), GREEN, (95, 126)),
        (230, "sync source", ("raises the gate only in", "a sweep; then low"), GREEN, (305, 126)),
        (440, "scan marker", ("high only while the", "mirror sweeps"), GREEN, (380, 243)),
        (650, "scan's process", ("counts frames; opens", "neither laser nor gate"), BLUE, (515, 330)),
    )
    for left, name, lines, colour, _ in below:
        parts.append(_box(left, 210, 150, 66, name, lines, colour))
    watch = ("holds the ports of laser and sync source; ends the", "light if no new frame is reported")
    note = "Orange: light. Green: hardware that ends it without a computer. Blue: software, never the only interlock."
    parts += [
        _arrow((95, 210), (95, 126), GREEN), _arrow((305, 210), (305, 126), GREEN),
        _arrow((440, 243), (380, 243), GREEN), _arrow((515, 126), (515, 210), GREEN),
        _box(230, 340, 360, 66, "guard: a process of its own", watch, BLUE),
        _arrow((305, 340), (305, 276), BLUE),
        _arrow((230, 373), (10, 373), (10, 93), (20, 93), BLUE), _arrow((725, 276), (725, 373), (590, 373), BLUE),
        text(600, 366, "frame numbers", size=11, colour=FAINT),
        text(14, 440, note, size=11, colour=FAINT),
    ]  # fmt: skip
    heads = "".join(
        f'<marker id="head-{colour[1:]}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
        f'orient="auto"><path d="M0 0L8 4L0 8z" fill="{colour}"/></marker>'
        for colour in (BLUE, ORANGE, GREEN)
    )
    return svg(830, 456, "What can end the light", [f"<defs>{heads}</defs>", *parts])


def pictures(named: Sequence[tuple[str, NDArray[np.uint8]]], pixel: int = 4) -> str:
    """RGB pictures (rows, width, 3) side by side, each colour as one path, in 16 steps of each channel."""
    parts, left, height = [], 14, 0
    for name, picture in named:
        rows, width = picture.shape[:2]
        coarse = picture // 16 * 16 + 8 * (picture > 0)
        by_colour: dict[str, list[str]] = {}
        for row in range(rows):
            line = coarse[row].astype(int)
            starts = np.flatnonzero(np.r_[True, (np.diff(line, axis=0) != 0).any(axis=1)])
            for start, end in zip(starts, np.r_[starts[1:], width], strict=True):
                colour = "#{:02x}{:02x}{:02x}".format(*line[start])
                by_colour.setdefault(colour, []).append(f"M{start} {row}h{end - start}v1h{start - end}z")
        parts.append(f'<g transform="translate({left} 36) scale({pixel})" shape-rendering="crispEdges">')
        parts += [f'<path fill="{colour}" d="{"".join(runs)}"/>' for colour, runs in by_colour.items()]
        parts += ["</g>", text(left, 36 + rows * pixel + 18, name)]
        left, height = left + width * pixel + 20, max(height, rows * pixel)
    return svg(
        left - 6, height + 66, "A street in fog: what the sensor counted, and what the program made of it", parts
    )


def _path(points: Sequence[tuple[float, float]], colour: str, dashes: str = "") -> str:
    dashed = f' stroke-dasharray="{dashes}"' if dashes else ""
    placed = "L".join(f"{a:.1f} {b:.1f}" for a, b in points)
    return f'<path d="M{placed}" fill="none" stroke="{colour}" stroke-width="1.8"{dashed}/>'


def _pulses(spans: Sequence[tuple[float, float]], base: float, left: float, right: float, colour: str) -> str:
    edges = "".join(f"H{a:.1f}V{base - 18:.1f}H{max(b, a + 1):.1f}V{base:.1f}" for a, b in spans)
    return f'<path d="M{left} {base:.1f}{edges}H{right}" fill="none" stroke="{colour}" stroke-width="1.8"/>'


def _box(left: float, top: float, width: float, height: float, name: str, lines: Sequence[str], colour: str) -> str:
    middle = left + width / 2
    place = f'x="{left}" y="{top}" width="{width}" height="{height}" rx="6"'
    parts = [
        f'<rect {place} fill="#ffffff" stroke="{colour}" stroke-width="2"/>',
        text(middle, top + 20, name, anchor="middle", bold=True),
        *(text(middle, top + 38 + 15 * i, line, anchor="middle", size=11) for i, line in enumerate(lines)),
    ]
    return "".join(parts)


def _arrow(*places: tuple[float, float] | str) -> str:
    """A line through the places with a head at the last; the colour comes at the end."""
    *points, colour = places
    placed = "L".join(f"{point[0]} {point[1]}" for point in points)
    head = f'marker-end="url(#head-{str(colour)[1:]})"'
    return f'<path d="M{placed}" fill="none" stroke="{colour}" stroke-width="2" {head}/>'
