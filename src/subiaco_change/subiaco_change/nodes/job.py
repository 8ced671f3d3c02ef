"""A change job in a thread of its own, so that the node goes on answering."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from subiaco_change.outputs.preview import ChangePreview
from subiaco_change.request import ChangeRequest
from subiaco_geo.errors import InputError, SubiacoError

Report = Callable[[str, float], None]
#: Told the stage and the name of a tile that is done.
OnTile = Callable[[str, str], None]


@dataclass(frozen=True)
class Outcome:
    """What a change job leaves: what viewers are shown, and when the later survey ended (0 where unknown)."""

    preview: ChangePreview
    end_ns: int


#: The step that the node wraps; it raises SubiacoError, and lets what ``report`` raises pass.
Detect = Callable[[ChangeRequest, Report, OnTile], Outcome]


class JobCancelledError(SubiacoError):
    """The job was cancelled between two stages."""


class JobThread:
    """Run one request; poll it from the node's thread.

    Parameters
    ----------
    request : ChangeRequest
    detect : callable
    """

    def __init__(self, request: ChangeRequest, detect: Detect) -> None:
        self.request = request
        self.stage, self.fraction, self.tile = "waiting", 0.0, ""
        self.outcome: Outcome | None = None
        self.error: BaseException | None = None
        self._cancelled = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(detect,), name="change", daemon=True)
        self._thread.start()

    @property
    def finished(self) -> bool:
        """Whether outcome or error is there."""
        return not self._thread.is_alive()

    def wait(self, seconds: float) -> None:
        """Leave the interpreter to the job until it has finished, but for so long at most [s]."""
        self._thread.join(seconds)

    def cancel(self) -> None:
        """Ask the job to stop at the next stage."""
        self._cancelled.set()

    def get(self) -> Outcome:
        """Return the outcome of a finished job, or raise what ended it."""
        if self.error is not None:
            raise self.error
        if self.outcome is None:
            raise InputError("the change job has not finished")
        return self.outcome

    def _report(self, stage: str, fraction: float) -> None:
        if self._cancelled.is_set():
            raise JobCancelledError("cancelled")
        if stage != self.stage:
            self.tile = ""
        self.stage, self.fraction = stage, fraction

    def _on_tile(self, stage: str, tile: str) -> None:
        if stage == self.stage:
            self.tile = tile

    def _run(self, detect: Detect) -> None:
        try:
            self.outcome = detect(self.request, self._report, self._on_tile)
        except BaseException as error:  # noqa: BLE001 - handed to the node's thread, which raises it
            self.error = error
