"""Who gets in: the page for who knows the token, its socket for that page, nothing for anybody else."""

from __future__ import annotations

import errno
import hmac
import socket
from http import HTTPStatus
from ipaddress import ip_address
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

from ..errors import OutputError
from .page import page

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

_LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
_HEADERS = {
    "Content-Type": "text/html; charset=utf-8",
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


def is_loopback(host: str) -> bool:
    """Whether only this computer reaches a host."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def is_socket(request: Request) -> bool:
    """Whether somebody asks for the WebSocket."""
    return urlsplit(request.path).path == "/socket"


def refusal(request: Request, token: str, *, local: bool) -> str:
    """Why a request is refused; empty if it is not.

    Parameters
    ----------
    request : Request
    token : str
        That the address must have; compared in a time that tells nothing of it.
    local : bool
        Whether the server is meant for this computer only: then under no other name, by which pages from elsewhere
        could have their own addresses lead here.
    """
    given = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
    hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
    host = hosts[0] if len(hosts) == 1 else ""
    if local and host.rpartition(":")[0] not in _LOOPBACK:
        return "not under that name"
    if not hmac.compare_digest(given.encode(errors="replace"), token.encode()):
        return "the address lacks the token that the command printed"
    if origins and origins != [f"http://{host}"]:
        return "not from that origin"
    return ""


def answer(connection: ServerConnection, request: Request) -> Response:
    """The page, to who may have it."""
    if urlsplit(request.path).path != "/":
        return connection.respond(HTTPStatus.NOT_FOUND, "there is one page, at /\n")
    found = connection.respond(HTTPStatus.OK, page())
    del found.headers["Content-Type"]
    for name, value in _HEADERS.items():
        found.headers[name] = value
    return found


def require_address(address: tuple[str, int]) -> None:
    """Raise if it cannot be listened on now: what is to be served may take long to make.

    Raises
    ------
    OutputError
    """
    try:
        problems = []
        for family, kind, _, _, where in (found := socket.getaddrinfo(*address, type=socket.SOCK_STREAM)):
            try:
                with socket.socket(family, kind) as bound:
                    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                    bound.bind(where)
            except OSError as error:
                # A name may stand for addresses of kinds that this machine does not have.
                if error.errno not in (errno.EAFNOSUPPORT, errno.EADDRNOTAVAIL):
                    raise
                problems.append(error)
        if len(problems) == len(found):
            raise problems[0]
    except OSError as error:
        raise cannot_listen(address, error) from None


def cannot_listen(address: tuple[str, int], error: OSError) -> OutputError:
    """Error that says why, and what to do."""
    where = "{}:{}".format(*address)
    return OutputError(f"cannot listen on {where}: {error}; give another --port", path=where)
