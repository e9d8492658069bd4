"""A session in real time, in a thread of its own: commands in, frames out."""

from __future__ import annotations

import json
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..errors import OutputError, PCRError
from ..files import saved
from .commands import LATEST, SLOW, Message, apply
from .frames import about, frame
from .live.session import Session

FRAMES = 60.0  # a second
_WAKE = 0.002  # s, between looks at the clock
_LATE = 2.0  # frames that may be made up for
_SLIP = 0.1  # s of real time by which it may be behind; what is more is lost
_QUEUE = 200  # commands that may wait

Publish = Callable[[str, Any], None]


class Runner(threading.Thread):
    """Runs a session by the clock until it is told to end.

    Time is never made up for beyond a tenth of a second: where the machine is too slow, the robot's time runs slower,
    and frames say by how much.

    Parameters
    ----------
    make : callable
        () -> Session; called in this thread, to which its solvers belong.
    publish : callable
        (kind, what) -> None; called from this thread, with "about" (dict), "start" (robot, pose, mode), "frame"
        (number, text, q), "error" (sender, id, text), "busy" (whether what takes a while has begun, or is done),
        "saved" (dict), "ended" (error or None).
    folder : Path
        Where recordings go, each into a folder of its own.
    """

    def __init__(self, make: Callable[[], Session], publish: Publish, folder: Path) -> None:
        super().__init__(name="session", daemon=True)
        self._make, self._publish, self._folder = make, publish, folder
        self._asked: deque[tuple[Any, Message]] = deque()
        self._turn = threading.Condition()
        self._over = False
        self._heard, self._felt = 0, 0.0  # number of the last command, and when the plant first moved after it
        self._ratio = 1.0
        self._frames = 0

    def ask(self, sender: Any, message: Message) -> bool:
        """Have a command carried out; of a run of moves only the last. Returns whether there was room for it."""
        with self._turn:
            last = self._asked[-1] if self._asked else None
            if last is not None and last[0] is sender and message["do"] == last[1]["do"] in LATEST:
                self._asked[-1] = sender, message
            elif len(self._asked) < _QUEUE:
                self._asked.append((sender, message))
            else:
                return False
            self._turn.notify()
            return True

    def end(self) -> None:
        """End it, and wait until it has."""
        with self._turn:
            self._over = True
            self._turn.notify()
        if self.is_alive():
            self.join()

    def run(self) -> None:
        """See `Thread`."""
        try:
            session = self._make()
            self._publish("about", about(session))
            self._run(session)
        except BaseException as error:  # whatever it is, who waits is told
            self._publish("ended", error)
            return
        self._publish("ended", None)

    def _run(self, session: Session) -> None:
        told: Any = None
        last = second = next_frame = time.monotonic()
        owed, passed = 0.0, 0.0
        while not self._over:
            self._obey(session)
            if session.start_pose is not told:
                told = session.start_pose
                self._publish("start", (session.scene.robot, told, session.mode))
            self._save(session)
            now = time.monotonic()
            if session.paused:
                owed = 0.0
            else:
                owed = min(owed + session.speed * (now - last), _SLIP * session.speed)
                # In short pieces: a command need not wait for the rest.
                piece = min(owed, max(session.period, session.rig.dt))
                done = session.advance(piece) * session.rig.dt
                owed, passed = owed - done, passed + done
                if done and not self._felt:
                    self._felt = time.time()
            last = now
            if now - second >= 1.0:
                self._ratio, second, passed = passed / (now - second), now, 0.0
            if now >= next_frame:
                next_frame = max(next_frame + 1.0 / FRAMES, now - _LATE / FRAMES)
                self._show(session)
            wait = min(_WAKE, next_frame - time.monotonic())
            if owed < session.rig.dt and wait > 0.0:
                with self._turn:
                    if not self._asked and not self._over:
                        self._turn.wait(wait)

    def _obey(self, session: Session) -> None:
        while True:
            with self._turn:
                if not self._asked:
                    return
                sender, message = self._asked.popleft()
            if "id" in message:
                self._heard, self._felt = message["id"], 0.0
            slow = message["do"] in SLOW
            if slow:
                self._publish("busy", True)
            try:
                apply(session, message)
            except (PCRError, ValueError) as error:
                self._publish("error", (sender, message.get("id"), str(error)))
            except Exception as error:  # a fault of ours ends no session
                self._publish("error", (sender, message.get("id"), f"{type(error).__name__}: {error}"))
            if slow:
                self._publish("busy", False)

    def _show(self, session: Session) -> None:
        try:
            eq = session.rig.equilibrium()
        except PCRError:  # between two branches, for a moment
            return
        self._frames += 1
        found = frame(session, eq) | {"kind": "frame", "n": self._frames, "heard": self._heard}
        found["felt"] = round(1e3 * self._felt, 2) or None
        found["ratio"] = round(self._ratio, 3) if math.isfinite(self._ratio) else None
        self._publish("frame", (self._frames, json.dumps(found, separators=(",", ":")), eq.q))

    def _save(self, session: Session) -> None:
        recorder, session.finished = session.finished, None
        if recorder is None or recorder.run is None:
            return
        run = recorder.run
        number = 1
        while (self._folder / str(number)).exists():
            number += 1
        try:
            folder, problem = saved(lambda where: run.save(where), self._folder / str(number))
        except (OSError, OutputError, PCRError, ValueError) as error:
            self._publish("saved", {"problem": f"the recording could not be written: {error}"})
            return
        session.tell("recorded", f"{run.t[-1]:.2f} s written to {folder}")
        self._publish("saved", {"folder": str(folder), "problem": problem})
