"""What happened in a session: events, and what is recorded."""

from __future__ import annotations

from collections import deque
from typing import Any

from ...errors import PCRError
from .pilot import Pilot
from .recorder import Recorder
from .rig import Rig

_EVENTS = 30


class Journal:
    """Base of a session: keeps what it tells.

    Attributes
    ----------
    t : float
        Time of the session [s].
    events : deque of dict
        The last ones: number, time, kind, message, and for a snap rod, place and energy.
    recorder, finished : Recorder or None
        What records now, and the last that was ended.
    """

    def __init__(self) -> None:
        self.t = 0.0
        self.events: deque[dict[str, Any]] = deque(maxlen=_EVENTS)
        self._told_events = 0
        self.recorder: Recorder | None = None
        self.finished: Recorder | None = None

    def tell(self, kind: str, message: str, **more: Any) -> None:
        """Note an event."""
        self._told_events += 1
        self.events.append({"n": self._told_events, "t": round(self.t, 4), "kind": kind, "message": message, **more})
        if self.recorder is not None:
            self.recorder.tell(self.t, kind, message)

    def end_record(self, pilot: Pilot, rig: Rig) -> None:
        """End the record, if there is one."""
        if self.recorder is None:
            return
        recorder, self.recorder = self.recorder, None
        try:
            self.finished = recorder.ended(pilot, rig)
        except PCRError as error:
            self.tell("refused", str(error))
