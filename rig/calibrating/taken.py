"""Views that were taken, of whichever source: kept as they come, none of them twice, all of one rig."""

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from calibration.errors import Degenerate
from calibration.files.camera_file import corners_digest
from calibration.model.rig_model import Identity
from calibration.views import View
from rig.calibrating.capture import Capture
from rig.calibrating.session import Session
from rig.calibrating.showing import Tell
from rig.calibrating.view_text import told
from rig.calibration_identity import same_rig
from rig.errors import UsageError


class Taken:
    """What was taken. views: all of them. refused: why some have no corners, by the view's name. identity: of the rig,
    None: not known.
    """

    def __init__(self, session: Session, tell: Tell | None = None, of_camera: Collection[str] = ()) -> None:
        """session: where views are kept; tell: is told of each; of_camera: `corners_digest` of the views that a camera
        known from elsewhere was made of.
        """
        self.views: list[View] = []
        self.refused: dict[str, Degenerate] = {}
        self.identity: Identity | None = None
        self._session = session
        self.tell = tell
        self._seen: dict[str, str] = {}
        self._of_camera = of_camera

    def add(
        self,
        view: View,
        refused: Degenerate | None = None,
        identity: Identity | None = None,
        source: Path | None = None,
    ) -> None:
        """One more; a name that there is already gets a number. source: the file or run that it is from. UsageError for
        one that there is already: it would count twice.
        """
        self._require_new(view, str(source or view.name))
        if view.name in [known.name for known in self.views]:
            view = replace(view, name=f"{view.name}-{len(self.views)}")
        self.views.append(view)
        if refused is not None:
            self.refused[view.name] = refused
        self._of_rig(identity)
        self._session.add(view)
        self.say(told(view, refused))

    def say(self, line: str) -> None:
        """Tell whoever listens."""
        if self.tell is not None:
            self.tell(line)

    def _require_new(self, view: View, where: str) -> None:
        if view.corners is None:
            return
        digest = corners_digest(view)
        if digest in self._of_camera:
            raise UsageError(
                f"{where} holds a view that the camera was made of; a view must not count twice: give other views "
                "(of a simulated rig: another --seed), or leave the camera out"
            )
        if digest in self._seen:
            raise UsageError(
                f"{where} holds the very corners of {self._seen[digest]}; a view must not count twice: name it once, "
                "or show the board again"
            )
        self._seen[digest] = where

    def _of_rig(self, identity: Identity | None) -> None:
        if identity is None:
            return
        if self.identity is None:
            self._session.note_rig(identity)
        elif not same_rig(self.identity, identity):
            raise UsageError(
                f"views are of two rigs: {self.identity.name} ({_devices(self.identity)}) and {identity.name} "
                f"({_devices(identity)}); calibrate each with its own"
            )
        self.identity = identity

    def add_capture(self, capture: Capture, source: Path | None = None) -> None:
        """The view of a scan, of a recorded one where a source is named."""
        self.add(capture.view, capture.refused, capture.identity, source)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the pictures. UsageError where views are of different sizes."""
        sizes = {view.picture.shape[::-1] for view in self.views if view.picture is not None}
        if len(sizes) != 1:
            named = ", ".join(f"{width} x {height}" for width, height in sorted(sizes)) or "none"
            raise UsageError(f"pictures of the views have sizes {named}; views of one sensor make a calibration")
        width, height = sizes.pop()
        return width, height


def _devices(identity: Identity) -> str:
    return ", ".join([*identity.kinds.values(), *identity.serials.values()])
