"""Page and robot over HTTP and a WebSocket: one page steers, the others look on."""

from __future__ import annotations

import asyncio
import secrets
import sys
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import interrupt
from ..errors import OutputError, PCRError
from ..plant.robot import Robot
from .commands import LONGEST, MessageError, read
from .door import answer, cannot_listen, is_loopback, is_socket, refusal, require_address
from .live.session import Session
from .pages import Page, quiet, text_of
from .runner import Runner
from .scenery import Scenery

if TYPE_CHECKING:
    from websockets.asyncio.server import Server, ServerConnection
    from websockets.http11 import Request, Response

_LISTEN = 0.05  # s, between looks at whether to end
_PAGES = 16  # at once
_TURN = 1e-3  # s, after which threads take turns: a command does not wait for the robot
_GHOSTS = 0.1  # s between two looks for ghosts


class ViewServer:
    """Serves one session to pages that know its token.

    Parameters
    ----------
    make : callable
        () -> Session; called in the session's own thread.
    address : (str, int)
        Host and port; port 0 takes a free one.
    folder : Path
        For recordings.
    anywhere : bool
        Listen on other than loopback addresses too.

    Attributes
    ----------
    counts : Counter
        Pages; frames, and those that were dropped for a page; commands, wrong messages; requests that were refused.

    Raises
    ------
    OutputError
        The address is none of loopback.
    """

    def __init__(
        self, make: Callable[[], Session], address: tuple[str, int], folder: Path, *, anywhere: bool = False
    ) -> None:  # fmt: skip
        try:
            import websockets  # noqa: F401
        except ImportError as error:
            raise PCRError("the view needs websockets: pip install 'pcr_mpc[view]'") from error
        host = address[0]
        local = is_loopback(host)
        if not (local or anywhere):
            raise OutputError(f"{host} is no loopback address: whoever can see the page's address there moves the "
                              "robot; if that is meant, say --anywhere", path=host)  # fmt: skip
        if not 0 <= address[1] < 1 << 16:
            raise OutputError(f"port is {address[1]}, expected 0 (any that is free) to 65535", path=host)
        self.token = secrets.token_urlsafe(16)
        self.address = address
        self.counts: Counter[str] = Counter()
        self._make, self._folder, self._local = make, folder, local
        self._pages: list[Page] = []
        self._steering: Page | None = None
        self._kept: dict[str, str] = {}  # what a page must know, by kind
        self._q: np.ndarray | None = None
        self._robot: Robot | None = None
        self._failure: BaseException | None = None
        self._ready: asyncio.Event
        self._over = False

    @property
    def url(self) -> str:
        """Address of the page, with its token."""
        host = f"[{self.address[0]}]" if ":" in self.address[0] else self.address[0]
        return f"http://{host}:{self.address[1]}/?token={self.token}"

    def serve(self, tell: Callable[[str], None], *, until: Callable[[], bool] = lambda: False) -> None:
        """Serve until Ctrl-C, or ``until`` says so; ``tell`` is told the address once the robot moves.

        Raises
        ------
        OutputError
            The address cannot be listened on.
        PCRError, ValueError
            The session could not be made, or failed.
        KeyboardInterrupt
            On Ctrl-C.
        """
        require_address(self.address)
        # Ghosts, which are asked for, do not wait for the workspace.
        self._behind, self._other = Scenery(), Scenery()
        before = sys.getswitchinterval()
        sys.setswitchinterval(_TURN)
        try:
            asyncio.run(self._main(tell, until))
        finally:
            sys.setswitchinterval(before)
            self._end_scenery()

    async def _main(self, tell: Callable[[str], None], until: Callable[[], bool]) -> None:
        from websockets.asyncio.server import serve

        loop = asyncio.get_running_loop()
        self._ready, self._loop = asyncio.Event(), loop

        def publish(kind: str, what: Any) -> None:
            with suppress(RuntimeError):  # the loop has ended meanwhile
                loop.call_soon_threadsafe(self._published, kind, what)

        runner = self._runner = Runner(self._make, publish, self._folder)
        runner.start()
        try:
            while not self._ready.is_set():
                interrupt.check()
                await asyncio.sleep(_LISTEN)
            self._raise()
            server: Server
            async with serve(
                self._connected, *self.address, process_request=self._requested, compression=None, max_size=LONGEST,
                max_queue=64, open_timeout=5, close_timeout=1, ping_interval=20, server_header=None, logger=quiet(),
            ) as server:  # fmt: skip
                self.address = self.address[0], next(iter(server.sockets)).getsockname()[1]
                tell(self.url)
                ghosts = asyncio.ensure_future(self._look_for_ghosts())
                try:
                    while not until():
                        interrupt.check()
                        self._raise()
                        await asyncio.sleep(_LISTEN)
                finally:
                    ghosts.cancel()
        except OSError as error:
            raise cannot_listen(self.address, error) from None
        finally:
            self._over = True
            self._end_scenery()
            await loop.run_in_executor(None, runner.end)

    def _end_scenery(self) -> None:
        for each in (self._behind, self._other):
            each.end()

    def _raise(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _published(self, kind: str, what: Any) -> None:
        if kind == "frame":
            number, text, self._q = what
            self.counts["frames"] += 1
            for each in self._pages:
                self.counts["dropped"] += each.offer(number, text)
        elif kind == "about":
            self._kept["about"] = text_of("about", **what)
            self._ready.set()
        elif kind == "start":
            self._robot = what[0]
            self._draw_workspace(*what)
        elif kind == "error":
            what[0].tell(text_of("error", id=what[1], message=what[2]))
        elif kind == "busy":
            self._tell_all(text_of("busy", on=what))
        elif kind == "saved":
            self._tell_all(text_of("saved", **what))
        elif kind == "ended" and not self._over:
            self._failure = what or PCRError("the session has ended")
            self._ready.set()

    def _draw_workspace(self, robot: Robot, pose: Any, mode: str) -> None:
        self._kept.pop("workspace", None)

        def find() -> None:
            found = self._behind.workspace(pose)
            if found is not None and not self._over:
                self._loop.call_soon_threadsafe(self._keep, "workspace", text_of("workspace", mode=mode, **found))

        threading.Thread(target=find, daemon=True).start()

    def _keep(self, kind: str, text: str) -> None:
        self._kept[kind] = text
        self._tell_all(text)

    def _tell_all(self, text: str) -> None:
        for each in self._pages:
            each.tell(text)

    async def _look_for_ghosts(self) -> None:
        last: np.ndarray | None = None
        whole = False
        while True:
            await asyncio.sleep(_GHOSTS)
            wanting = [each for each in self._pages if each.ghosts]
            if not wanting or self._q is None or self._robot is None:
                last = None
                continue
            q = np.round(self._q, 4)
            still = last is not None and bool(np.abs(q - last).max() < 1e-3)
            if still and whole:
                continue
            found = await asyncio.to_thread(self._other.ghosts, self._robot, q, anew=still)
            if found is None:
                return
            last, whole = q, bool(found.get("all", True))
            text = text_of("ghosts", **found)
            for each in wanting:
                each.tell(text)

    def _requested(self, connection: ServerConnection, request: Request) -> Response | None:
        """Hand out the page, let its socket in, and nobody else."""
        refused = refusal(request, self.token, local=self._local)
        if not refused and is_socket(request):
            if len(self._pages) < _PAGES:
                return None
            refused = f"{_PAGES} pages look on already"
        if refused:
            self.counts["refused"] += 1
            return connection.respond(HTTPStatus.FORBIDDEN, f"{refused}\n")
        return answer(connection, request)

    async def _connected(self, connection: ServerConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        one = Page(connection)
        self.counts["pages"] += 1
        for kind in ("about", "workspace"):
            if kind in self._kept:
                one.tell(self._kept[kind])
        self._pages.append(one)
        if self._steering is None:
            self._steering = one
        self._say_who_steers()
        sender = asyncio.ensure_future(one.keep_up())
        try:
            async for text in connection:
                self._take(one, text)
        except ConnectionClosed:
            pass
        finally:
            sender.cancel()
            await asyncio.gather(sender, return_exceptions=True)
            self._pages.remove(one)
            if self._steering is one:
                # Nobody holds the robot any more; else all goes on.
                self._runner.ask(one, {"do": "release"})
                self._steering = None
            self._say_who_steers()

    def _take(self, one: Page, text: str | bytes) -> None:
        """Do what a message of a page asks for, if it may."""
        try:
            message = read(text)
        except MessageError as error:
            self.counts["wrong"] += 1
            one.tell(text_of("error", id=None, message=str(error)))
            return
        name = message["do"]
        if name == "seen":
            one.saw(message["n"])
            return
        self.counts["commands"] += 1
        if name == "ghosts":
            one.ghosts = message["on"]
        elif name == "steer":
            if self._steering is not None and self._steering is not one:
                self._runner.ask(self._steering, {"do": "release"})
            self._steering = one
            self._say_who_steers()
        elif self._steering not in (None, one):
            one.tell(text_of("error", id=message.get("id"), message="another page steers; take over first"))
        else:
            if self._steering is None:
                self._steering = one
                self._say_who_steers()
            if not self._runner.ask(one, message):
                one.tell(text_of("error", id=message.get("id"), message="too many commands at once"))

    def _say_who_steers(self) -> None:
        for each in self._pages:
            free = self._steering is None
            each.tell(text_of("role", steers=self._steering is each, free=free, pages=len(self._pages)))
