"""Browsers that look at a session."""

from __future__ import annotations

import asyncio
import json
import logging
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

_AHEAD = 5  # frames that a page may not have drawn yet: three wait in it for the screen
_UNHEARD = 200  # messages that wait for a page, beyond which nobody is there


class Page:
    """One browser that is connected.

    Attributes
    ----------
    waiting : str or None
        Newest frame that it was not sent.
    news : list of str
        What is not to be missed, and was not sent yet.
    sent : list of int
        Numbers of the frames that it was sent and has not drawn yet.
    ghosts : bool
        Whether it shows them.
    """

    def __init__(self, connection: ServerConnection) -> None:
        self.connection = connection
        self.waiting: str | None = None
        self.news: list[str] = []
        self.sent: list[int] = []
        self.number = 0
        self.ghosts = False
        self.due = asyncio.Event()

    def offer(self, number: int, text: str) -> bool:
        """Take a frame in the place of one that waits; returns whether one was dropped for it."""
        dropped = self.waiting is not None
        self.waiting, self.number = text, number
        self.due.set()
        return dropped

    def tell(self, text: str) -> None:
        """Have something said that is not to be missed; who does not listen for long is hung up on."""
        self.news.append(text)
        if len(self.news) > _UNHEARD:
            self.news.clear()
            self.connection.transport.abort()
        self.due.set()

    def saw(self, number: int) -> None:
        """Note that it has drawn a frame."""
        self.sent = [each for each in self.sent if each > number]
        self.due.set()

    async def keep_up(self) -> None:
        """Send news and the newest frame, as fast as they are drawn; a slow page misses frames."""
        while True:
            await self.due.wait()
            self.due.clear()
            while self.news:
                await self.connection.send(self.news.pop(0))
            if self.waiting is not None and len(self.sent) < _AHEAD:
                text, self.waiting = self.waiting, None
                self.sent.append(self.number)
                await self.connection.send(text)


def text_of(kind: str, **more: Any) -> str:
    """A message to a page."""
    return json.dumps({"kind": kind, **more}, separators=(",", ":"))


def quiet() -> logging.Logger:
    """Where the library may say what goes wrong with a connection; here nobody listens."""
    logger = logging.getLogger("pcr_mpc.view")
    logger.addHandler(logging.NullHandler())
    logger.propagate = False
    return logger
