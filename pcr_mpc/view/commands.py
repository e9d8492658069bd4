"""What a page may ask for: each message is checked against its form before anything is done."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

from ..errors import PCRError
from .live.session import Session

LONGEST = 2048  # bytes of a message
_FAR = 1e3  # m and rad: beyond that nothing is meant

Message = dict[str, Any]


class MessageError(PCRError):
    """A message that is none of those which there are."""


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and abs(value) < _FAR


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 53


def _word(value: Any) -> bool:
    return isinstance(value, str) and 0 < len(value) <= 100


def _switch(value: Any) -> bool:
    return isinstance(value, bool)


_Check = Callable[[Any], bool]
# Command -> the form of each of its arguments, and what it does to a session.
_COMMANDS: dict[str, tuple[dict[str, _Check], Callable[..., None]]] = {
    "drag": ({"x": _number, "y": _number}, lambda session, x, y: session.drag(x, y)),
    "motor": ({"i": _whole, "angle": _number}, lambda session, i, angle: session.drag_motor(i, angle)),
    "release": ({}, lambda session: session.release()),
    "target": ({"x": _number, "y": _number}, lambda session, x, y: session.move_target(x, y)),
    "follow": ({}, lambda session: session.follow()),
    "stop": ({}, lambda session: session.stop()),
    "pause": ({"on": _switch}, lambda session, on: session.pause(on)),
    "step": ({}, lambda session: session.step_once()),
    "speed": ({"factor": _number}, lambda session, factor: session.slow_motion(factor)),
    "reset": ({}, lambda session: session.reset()),
    "mode": ({"mode": _word}, lambda session, mode: session.switch_mode(mode)),
    "controller": ({"name": _word}, lambda session, name: session.choose(name)),
    "set": ({"name": _word, "value": _number}, lambda session, name, value: session.set(name, value)),
    "record": ({"on": _switch}, lambda session, on: session.record(on)),
}
# Of which only the last one counts, and those that are the server's own business.
LATEST = ("drag", "motor", "target")
SLOW = ("mode", "controller", "set", "reset")  # a controller may be made for them, and its machine code built
_SERVERS: dict[str, dict[str, _Check]] = {"seen": {"n": _whole}, "steer": {}, "ghosts": {"on": _switch}}


def read(text: str | bytes) -> Message:
    """The message that a text is; an ``id`` beside its arguments is the page's own number of it.

    Raises
    ------
    MessageError
        It is none; says why.
    """
    if not isinstance(text, str):
        raise MessageError("a message is text, not bytes")
    if len(text) > LONGEST:
        raise MessageError(f"a message has at most {LONGEST} characters, this one has {len(text)}")
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        raise MessageError("a message is JSON, which this is not") from None
    if not isinstance(found, dict):
        raise MessageError("a message is an object with a do")
    name = found.get("do")
    form = _SERVERS.get(name) if isinstance(name, str) else None
    if form is None and isinstance(name, str) and name in _COMMANDS:
        form = _COMMANDS[name][0]
    if form is None:
        raise MessageError(f"do is {str(name)[:40]!r}, expected one of {', '.join([*_COMMANDS, *_SERVERS])}")
    given = {key: value for key, value in found.items() if key not in ("do", "id")}
    if given.keys() != form.keys():
        raise MessageError(
            f"{name} takes {', '.join(form) or 'nothing'}, and got {', '.join(given)[:100] or 'nothing'}"
        )
    for key, check in form.items():
        if not check(given[key]):
            raise MessageError(f"{name}: {key} is {str(given[key])[:40]!r}, which cannot be meant")
    if "id" in found and not _whole(found["id"]):
        raise MessageError("id is no number of a message")
    return found


def apply(session: Session, message: Message) -> None:
    """Do what a message says.

    Raises
    ------
    PCRError, ValueError
        It cannot be done; the session goes on as before.
    """
    arguments = {key: value for key, value in message.items() if key not in ("do", "id")}
    _COMMANDS[message["do"]][1](session, **arguments)
