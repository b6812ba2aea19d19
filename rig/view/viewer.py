"""`rig view`: serves the page of a running scan or of a finished run, until it is interrupted.

One thread, the caller's, holds all that is shown. It takes the wishes of the pages, looks for news, and tells the pages
what has changed; the server's thread only passes messages on. All pages show the same map in the same colours.
"""

import os
import threading
import time
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from drivers.errors import DeviceError
from rig.config.estimators import estimator_names
from rig.errors import RigError, UsageError
from rig.recording.map_rows import RowCounts
from rig.requests import ViewRequest
from rig.simd import Float32
from rig.view import health
from rig.view.access import Access, listen
from rig.view.estimation import Estimated, Estimation, EstimationRequest
from rig.view.live_source import LiveNews, LiveSource, LiveState
from rig.view.pages import Pages, PageWish
from rig.view.run_source import RunSource, read_map
from rig.view.server import ViewServer, require_viser
from rig.view.shown import COLOURS, Legend, Limits, ShownMap, picture_of, ply_of, points, steady_limits

MOST_POINTS: Final = 250_000
"""Most points of an update: 3.75 MB, at 15 bytes a point."""
MOST_RATE_HZ: Final = 10.0
_BEAT_S: Final = 0.1
"""Longest wait from one look for news to the next."""
_FOG_KEPT: Final = 600
_NICE: Final = 10
"""Priority below that of a scan on the same computer."""
_ASPECT: Final = 1.3
"""Width over height of the point cloud's part of the page, about."""
_PICTURES: Final = ("depth", "counts", "confidence")
_ENDED_ALONE: Final = "The scan has ended. This is its last map; this page shows no other scan."
_NO_SCAN: Final = "No scan of yours is running on this computer. This page waits for one: rig scan"
_STATES: Final = {
    LiveState.WAITING: _NO_SCAN,
    LiveState.LIVE: "",
    LiveState.ENDED: "The scan has ended. This is its last map; the page waits for the next scan.",
    LiveState.LOST: "The program that scanned is gone without an end. This is the last map that it showed.",
}

Ready = Callable[[str], None]
"""Called with the page's address once it can be opened."""


def view(
    run: str | os.PathLike[str] | None, request: ViewRequest | None = None, *, ready: Ready, **changes: Any
) -> None:
    """Serve a page that shows a run (`rig view`), until an interrupt (Ctrl-C).

    run: folder of a run, with or without recording; None shows the running scan, and waits for one.
    request, changes: options, as a `ViewRequest` or by the names of its fields. With `until_closed`, the page of a scan
    also ends once the scan is over and no browser shows it.
    ready: called with the page's address, token included, once it can be opened.
    Raises UsageError if there is nothing to show, viser is not installed, the page cannot be served at the address that
    was asked for, or an option is out of range; DamagedRecordingError for a recording without maps that is damaged.
    """
    request = replace(request or ViewRequest(), **changes)
    _require_possible(run, request)
    require_viser()
    source = LiveSource(request.process) if run is None else RunSource(Path(run))
    with ExitStack() as stack:
        shows: _ShowsLive | _ShowsRun
        if isinstance(source, LiveSource):
            stack.callback(source.close)
            shows = stack.enter_context(_ShowsLive(request, source))
        else:
            shows = stack.enter_context(_ShowsRun(request, source))
        url = shows.server.access.url()
        ready(url)
        if request.open_browser:
            webbrowser.open(url)
        with suppress(KeyboardInterrupt):
            shows.serve()


def _require_possible(run: str | os.PathLike[str] | None, request: ViewRequest) -> None:
    problems = []
    if request.process is not None and run is not None:
        problems.append("`process` is for a running scan; leave it out")
    if not 1 <= request.view_points <= MOST_POINTS:
        problems.append(f"`view_points` is {request.view_points}; it must be at least 1 and at most {MOST_POINTS}")
    if not 0 < request.view_rate <= MOST_RATE_HZ:
        problems.append(
            f"`view_rate` is {request.view_rate:g} a second; it must be above 0 and at most {MOST_RATE_HZ:g}"
        )
    if problems:
        raise UsageError.of(problems)


class _Shows:
    """The common part of both: the server, the map that is shown, and how."""

    def __init__(self, request: ViewRequest) -> None:
        self._asked = request
        self._wake = threading.Event()
        self.pages = Pages(self._wake)
        listening, access = listen(Access.to(request.host, request.port, request.token))
        try:
            self.server = ViewServer(access, listening, self.pages, self._download)
        except BaseException:
            listening.close()
            raise
        self._scene = self.server.viser.scene
        self._scene.set_up_direction("-y")
        self._cloud: Any = None
        self.title = ""
        self._shown: ShownMap | None = None
        self._label = ""
        self._estimated_again = False
        self._colour, self._least = "depth", 0.0
        self._limits: Limits | None = None
        self._told_s = -np.inf
        self._stale = False
        """Whether the pages show the map in other colours than was asked for since."""
        self._answered: dict[int, object] = {}

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Stop serving."""
        self.server.close()

    def serve(self) -> None:
        """Serve until an interrupt, or until `beat` says that it is over."""
        while self.beat():
            self._wake.wait(_BEAT_S)
            self._wake.clear()

    def beat(self) -> bool:
        """Take wishes and news; False if it is over."""
        raise NotImplementedError

    def row_counts(self, number: int, row: int) -> RowCounts | None:
        """Counts of a row of the shown map, if there are any."""
        raise NotImplementedError

    def why_no_counts(self, number: int) -> str:
        """The reason why `row_counts` has none of this map, for people."""
        raise NotImplementedError

    def say(self, text: str) -> None:
        """Show a sentence on all pages, in the place of the one before."""
        self.pages.tell("notice", {"text": text})

    @property
    def due(self) -> bool:
        """Whether the pages may be told a map again: not more often than was asked for."""
        return time.monotonic() - self._told_s >= 1.0 / self._asked.view_rate

    def tell_map(self) -> None:
        """Tell the pages the shown map: points, pictures and its description."""
        self._stale = False
        shown = self._shown
        if shown is None:
            return
        self._told_s = time.monotonic()
        self._limits = steady_limits(self._limits, shown.depth_m)
        found = points(shown, self._colour, self._least, self._asked.view_points, self._limits)
        told: dict[str, Any] = {
            "number": shown.number,
            "label": self._label,
            "colour": self._colour,
            "least": self._least,
            "points": 0 if found is None else len(found.xyz_m),
            "of_points": 0 if found is None else found.of,
            **_legend(None if found is None else found.legend),
            "again": self._estimated_again,
            "doubts": list(shown.about.get("doubts") or ()),
        }
        if found is None:
            if self._cloud is not None:
                self._cloud.remove()
                self._cloud = None
        else:
            spread = float(np.sqrt(found.of / len(found.xyz_m)))
            self._cloud = self._scene.add_point_cloud(
                "/map", found.xyz_m, found.rgb, point_size=spread * _pixel_m(shown), precision="float32",
                point_shape="square", point_shading="flat",
            )  # fmt: skip
        self.pages.tell("map", told)
        for what in _PICTURES:
            drawn = picture_of(shown, what, self._least, self._limits)
            told = {"there": drawn is not None, **_size(shown), **_legend(None if drawn is None else drawn.legend)}
            self.pages.tell(f"picture-{what}", told, b"" if drawn is None else drawn.png)

    def take_common(self, wish: PageWish) -> bool:
        """Fulfil a wish that both kinds of pages have; False for another one."""
        if wish.ask == "colour" and wish.values["by"] in COLOURS:
            self._colour = wish.values["by"]
        elif wish.ask == "confidence":
            self._least = min(max(wish.values["least"], 0.0), 1.0)
        else:
            return False
        self._stale = True
        return True

    def catch_up(self) -> None:
        """Tell the shown map again if another colour or confidence was asked for, and it is time."""
        if self._stale and self.due:
            self.tell_map()

    def answer_rows(self, following: Sequence[PageWish], news: object = None) -> None:
        """Tell each page about the pixel under its cursor, if that or the map has changed. news: another object
        whenever the counts may have."""
        self._answered = {wish.page: self._answered.get(wish.page) for wish in following}
        for wish in following:
            state = wish, self._shown, news
            before = self._answered[wish.page]
            if isinstance(before, tuple) and all(a is b for a, b in zip(before, state, strict=True)):
                continue
            self._answered[wish.page] = state
            self.pages.answer(wish.page, "row", self._row_answer(wish.values["row"], wish.values["x"]))

    def look_from_camera(self, distance_m: float, rays: tuple[Float32, Float32] | None = None) -> None:
        """Begin new pages with the view of the camera, turning about a point at this distance, wide enough for rays."""
        widest = 0.5
        if rays is not None and np.isfinite(rays[0]).any():
            widest = max(float(np.nanmax(np.abs(rays[1]))), float(np.nanmax(np.abs(rays[0]))) / _ASPECT)
        camera = self.server.viser.initial_camera
        camera.position, camera.look_at = (0.0, 0.0, -0.1 * distance_m), (0.0, 0.0, distance_m)
        camera.up, camera.fov = (0.0, -1.0, 0.0), 2 * float(np.arctan(widest))

    def _row_answer(self, row: int, x: int) -> dict[str, Any]:
        shown = self._shown
        if shown is None:
            return {"row": row, "x": x}
        column = shown.column_at(row, x)
        answer: dict[str, Any] = {"map": shown.number, "row": row, "x": x, "column": column, **shown.pixel(row, x)}
        counted = self.row_counts(shown.number, row)
        if column is None and counted is not None and len(counted.counts) == 1:
            column = 0  # of imported frames
        if column is not None and shown.stripe:
            answer["stripe"] = shown.stripe_at(row, column)
        if counted is not None and column is not None:
            answer |= {
                "profile": counted.counts[column],
                "exposures": int(counted.frames[column]),
                "window_px": [int(counted.begin_px[column]), int(counted.end_px[column])],
            }
            if answer["counts"] is None and 0 <= x < counted.counts.shape[1]:
                answer["counts"] = int(counted.counts[:, x].sum())
        elif counted is None:
            answer["why"] = self.why_no_counts(shown.number)
        return answer

    def _download(self) -> tuple[str, bytes] | None:
        """The shown points as a PLY file; called on another thread."""
        shown, least = self._shown, self._least
        ply = None if shown is None else ply_of(shown, least)
        name = "".join(c if c.isascii() and (c.isalnum() or c in "-_.") else "-" for c in self.title) or "map"
        return None if shown is None or ply is None else (f"{name}-{shown.number:06d}.ply", ply)


class _ShowsLive(_Shows):
    """The page of a running scan."""

    def __init__(self, request: ViewRequest, source: LiveSource) -> None:
        super().__init__(request)
        with suppress(AttributeError, OSError):  # there is none on Windows
            os.nice(_NICE)
        self._source = source
        self._fog: list[dict[str, Any]] = []
        self._figures: list[health.Figure] = []
        self._align: list[health.Figure] = []
        self._state: LiveState | None = None
        self._parent = os.getppid() if hasattr(os, "getppid") else 0
        self._tell_setup({}, "waiting for a scan")
        self.look_from_camera(5.0)

    def beat(self) -> bool:
        """Take wishes and news; False if it is over, because the scan has ended and nobody looks."""
        wishes, following = self.pages.wishes()
        for wish in wishes:
            if not self.take_common(wish) and wish.ask == "stop" and self._source.stop():
                self.say("The scan was asked to stop, as by Ctrl-C.")
        if following:
            self._source.follow(following[-1].values["row"])
        slot = self._source.slot
        news = self._source.poll(maps=self.due)
        self._take(news, begun=self._source.slot is not slot)
        self.catch_up()
        self.answer_rows(following, self._source.newest_row)
        over = self._source.state in (LiveState.ENDED, LiveState.LOST) or os.getppid() != self._parent
        return not (self._asked.until_closed and over and not self.pages.open)

    def row_counts(self, number: int, row: int) -> RowCounts | None:
        """Counts of a row of the newest map, if the scan has sent them."""
        return self._source.row(number, row)

    def why_no_counts(self, number: int) -> str:
        """The reason why the scan has not sent any."""
        if self._source.state is not LiveState.LIVE:
            return "the scan is over; the counts of its last map's rows went with it"
        return "the counts of this row come with the next map"

    def _take(self, news: LiveNews, begun: bool) -> None:
        if begun and self._source.slot is not None:
            self._fog.clear()
            self._align = []
            self._shown, self._limits, self._state = None, None, None
            self.pages.forget()
            self._tell_setup({}, self._source.slot.name)
        if news.setup is not None:
            near_m, far_m = news.setup.get("depth_range_m") or (1.0, 9.0)
            self.look_from_camera(0.5 * (near_m + far_m), self._source.rays)
            self._tell_setup(news.setup, str(news.setup.get("name") or ""))
        if news.status is not None:
            self._figures = health.of_status(news.status)
        if news.figures is not None:
            self._align = health.of_alignment(news.figures)
        if news.status is not None or news.figures is not None:
            self.pages.tell("health", {"figures": [*self._align, *self._figures]})
        if news.profile is not None:
            self.pages.tell("profile", {"profile": np.nan_to_num(news.profile)})
        if news.map is not None:
            self._shown, self._label = news.map, f"map {news.map.number}"
            self.tell_map()
            self._tell_fog(news.map)
        elif news.frames is not None and (self._shown is None or not self._shown.stripe):
            self._shown, self._label = news.frames, "the newest frames, no map yet"
            self.tell_map()
        if self._source.state is not self._state:
            self._state = self._source.state
            text = _STATES[self._state]
            if self._state is LiveState.ENDED and self._asked.process is not None:
                text = _ENDED_ALONE
            self.pages.tell("state", {"state": self._state.value, "text": text})

    def _tell_fog(self, shown: ShownMap) -> None:
        reading = health.fog_of(shown.about.get("fog"))
        self._fog.append({"map": shown.number, **(reading or {})})
        del self._fog[:-_FOG_KEPT]
        self.pages.tell("fog", {"readings": self._fog})

    def _tell_setup(self, setup: Mapping[str, Any], title: str) -> None:
        self.title = title
        calibration = (setup.get("config") or {}).get("calibration", "")
        uncalibrated = calibration is None and setup.get("kind") != "align"
        notes = ["No depth: the rig is not calibrated (rig calibrate)."] if uncalibrated else []
        told = {
            "live": True,
            "kind": setup.get("kind") or "live",
            "title": title,
            "numbers": [],
            "estimators": [],
            "notes": notes,
            "folder": setup.get("folder"),
            "exposures": setup.get("exposures"),
        }
        self.pages.tell("setup", told)


class _ShowsRun(_Shows):
    """The page of a finished run."""

    def __init__(self, request: ViewRequest, source: RunSource) -> None:
        super().__init__(request)
        self._source = source
        self._again: Estimation | None = None
        self._wanted: int | None = None
        """Number of the map that was asked for last, until it is shown."""
        self._stage = ""
        self.title = source.folder.absolute().name
        told = {
            "live": False,
            "kind": "run",
            "title": self.title,
            "numbers": source.numbers,
            "estimators": list(estimator_names()) if source.recorded else [],
            "estimator": source.summary.get("estimator"),
            "notes": source.notes,
            "folder": str(source.folder),
            "exposures": source.summary.get("exposures"),
        }
        self.pages.tell("setup", told)
        self.pages.tell("state", {"state": "run", "text": ""})
        self._tell_health(source.summary)
        self._fog = {number: {"map": number, **(health.fog_of(fog) or {})} for number, fog in source.fog}
        self._tell_fog()
        self._select(source.numbers[-1])

    def __exit__(self, *error: object) -> None:
        """Stop serving, and an estimate under way."""
        if self._again is not None:
            self._again.close()
        super().__exit__(*error)

    def beat(self) -> bool:
        """Take wishes, and the result of an estimate."""
        wishes, following = self.pages.wishes()
        for wish in wishes:
            if self.take_common(wish):
                continue
            if wish.ask == "map":
                self._wanted = wish.values["index"] if wish.values["index"] in self._source.numbers else self._wanted
                continue
            self._select_wanted()
            if wish.ask == "recorded" and self._shown is not None:
                self._select(self._shown.number)
            elif wish.ask == "estimate" and self._source.recorded and wish.values["estimator"] in estimator_names():
                self._begin(wish.values["estimator"])
        if self.due:
            self._select_wanted()
        self.catch_up()
        if self._again is not None:
            if (made := self._again.poll()) is not None:
                self._take(made)
            elif self._again.stage != self._stage:
                self._tell_estimate(self._again)
        self.answer_rows(following)
        return True

    def row_counts(self, number: int, row: int) -> RowCounts | None:
        """Counts of a row, from the recording."""
        return self._source.row(number, row)

    def why_no_counts(self, number: int) -> str:
        """The reason why the run has none."""
        return "the frames of this map are not recorded" if self._source.recorded else "this run has no recording"

    def _select_wanted(self) -> None:
        number, self._wanted = self._wanted, None
        if number is not None:
            self._select(number)

    def _select(self, number: int) -> None:
        try:
            self._shown, before = self._source.map(number), self._estimated_again
        except (RigError, DeviceError) as error:
            self.say(f"Map {number} cannot be shown: {error}")
            return
        self.say("")
        self._estimated_again = False
        if before:
            self._tell_fog()
            self._tell_health(self._source.summary)
        self._label = f"map {number}" if self._shown.stripe else f"counts of map {number}, which has no estimate"
        if not self._source.recorded and not self._shown.stripe:
            self._label = f"sum {number} of imported frames"
        if self._limits is None and self._shown.depth_m is not None and np.isfinite(self._shown.depth_m).any():
            self.look_from_camera(float(np.nanmedian(self._shown.depth_m)), self._shown.rays)
        self.tell_map()

    def _begin(self, estimator: str) -> None:
        if self._again is not None:
            self.say("An estimate is under way; wait for it.")
            return
        if self._shown is None or self._source.rows is None:
            self.say("No recorded map is shown that could be estimated again.")
            return
        least = self._least or self._source.min_confidence
        cut = self._source.rows.plan.blanking is None
        asked = EstimationRequest(self._source.folder, self._shown.number, estimator, least, cut)
        try:
            self._again = Estimation(asked)
        except UsageError as error:
            self.say(str(error))
            return
        self._tell_estimate(self._again)

    def _tell_estimate(self, again: Estimation) -> None:
        self._stage = again.stage
        text = f"estimating map {again.request.number} with {again.request.estimator}: {again.stage}"
        self.pages.tell("estimate", {"busy": True, "text": text})

    def _take(self, made: Estimated) -> None:
        assert self._again is not None, "it was polled"
        asked = made.request
        try:
            if made.folder is None:
                text = f"Map {asked.number} could not be estimated with {asked.estimator}: {made.problem}"
                self.say(text)
            else:
                rows = self._source.rows
                rays = None if rows is None or rows.model is None else rows.geometry.rays
                found = read_map(made.folder, made.number, rays, {"min_confidence": asked.min_confidence})
                self._shown, self._estimated_again = replace(found, number=asked.number), True
                took_s = float(made.summary.get("compute_time_s") or 0.0)
                self._label = f"map {asked.number}, estimated again with {asked.estimator} in {took_s:.2g} s"
                if asked.number and not asked.by_cutting:
                    self._label += ", maps before it included"
                self.tell_map()
                self._tell_health(made.summary)
                again = health.fog_of(made.summary.get("fog"))
                self._tell_fog({asked.number: {"map": asked.number, **again}} if again else {})
        except RigError as error:
            self.say(str(error))
        finally:
            self._again.close()
            self._again = None
            self.pages.tell("estimate", {"busy": False, "text": ""})

    def _tell_health(self, summary: Mapping[str, Any]) -> None:
        """Tell the figures of a summary: of the run, or of a map that was estimated again."""
        self.pages.tell("health", {"figures": health.of_summary(summary, self._source.manifest)})

    def _tell_fog(self, again: Mapping[int, dict[str, Any]] | None = None) -> None:
        """Tell the readings of all maps. again: of a map that was estimated again, in the place of the run's."""
        readings = sorted((self._fog | dict(again or {})).items())
        kept = readings if len(readings) <= _FOG_KEPT else readings[:: -(-len(readings) // _FOG_KEPT)]
        self.pages.tell("fog", {"readings": [reading for _, reading in kept]})


def _pixel_m(shown: ShownMap) -> float:
    """Size of points in metres: the distance of neighbouring pixels on the nearer surfaces. Larger ones would hide what
    is behind them."""
    assert shown.depth_m is not None, "it has points"
    assert shown.rays is not None, "it has points"
    step = float(np.nanmedian(np.abs(np.diff(shown.rays[0], axis=1))))
    return 1.2 * float(np.nanpercentile(shown.depth_m, 40)) * (step if np.isfinite(step) else 2e-3)


def _legend(legend: Legend | None) -> dict[str, Any]:
    if legend is None:
        return {"legend": [], "ends": ["", ""]}
    return {"legend": [f"rgb({r},{g},{b})" for r, g, b in legend.rgb.tolist()], "ends": list(legend.ends)}


def _size(shown: ShownMap) -> dict[str, int]:
    for array in (shown.depth_m, shown.counts):
        if array is not None:
            return {"rows": array.shape[0], "width": array.shape[1]}
    rows = len(shown.stripe["x_px"]) if shown.stripe else 0
    return {"rows": rows, "width": 0}
