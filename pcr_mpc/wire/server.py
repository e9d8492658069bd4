"""The controller as a UDP server."""

from __future__ import annotations

import math
import select
import socket
import time
from collections import Counter, deque
from collections.abc import Callable
from ipaddress import ip_address

from .. import interrupt
from ..errors import OutputError, PCRError
from .decider import Decider, at_rest
from .packet import Measurement, command_size, measurement_size, newer, pack_command, unpack_measurement

_ASKED = 0.05  # s, between looks at whether it is over
_QUICK = 0.5  # of a period, in which an answer is reckoned: then those who wait can all be answered
_QUEUE = 100  # datagrams that are read at once


def require_address(address: tuple[str, int], *, anywhere: bool = False) -> None:
    """Raise if a server could not listen there now, or is not to: what it needs else may take long to make.

    Raises
    ------
    OutputError
        The address cannot be listened on, or is none of loopback.
    """
    _bound(address, anywhere=anywhere).close()


def _bound(address: tuple[str, int], *, anywhere: bool) -> socket.socket:
    host, port = address
    try:
        loopback = ip_address(socket.gethostbyname(host)).is_loopback
        if not (loopback or anywhere):
            raise OutputError(f"{host} is no loopback address: whoever can send there moves the motors; "
                              "if that is meant, say --anywhere", path=host)  # fmt: skip
        bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            bound.bind((host, port))
        except BaseException:
            bound.close()
            raise
        return bound
    except (OSError, OverflowError) as error:
        raise OutputError(f"cannot listen on {host}:{port}: {error}", path=f"{host}:{port}") from None


class Server:
    """Answers each measurement with a command, and nothing else with anything.

    What is no measurement, comes from somebody else than whom it has begun to serve, is old or comes twice, is counted
    and ignored. Where the controller has no answer, and after ``silence`` periods without a measurement (then by
    commands of its own, one a period), the motors are brought to rest. Then whoever comes next is served, from where
    the robot is then.

    Parameters
    ----------
    decider : Decider
    address : (str, int)
        Host and port; port 0 takes a free one.
    silence : int
        Periods.
    anywhere : bool
        Listen on other than loopback addresses too.

    Attributes
    ----------
    address : (str, int)
        Where it listens.
    counts : Counter
        Packets: answered, wrong (size, magic, version, kind, number of motors or checksum), foreign, old (or repeated),
        skipped as a later one was there already; rests, how often silence has brought the motors to rest; failures, how
        often the controller had no answer.
    problem : str
        The last failure.

    Raises
    ------
    OutputError
        The address cannot be listened on, or is none of loopback.
    """

    def __init__(
        self, decider: Decider, address: tuple[str, int], *, silence: int = 5, anywhere: bool = False
    ) -> None:  # fmt: skip
        self._socket = _bound(address, anywhere=anywhere)
        self._socket.setblocking(False)
        self.address: tuple[str, int] = self._socket.getsockname()[:2]
        self.counts: Counter[str] = Counter()
        self.problem = ""
        self._decider, self._silence = decider, silence
        self._peer: tuple[str, int] | None = None
        self._last: Measurement | None = None
        self._resting, self._spent = False, deque([0.0], maxlen=3)
        self._size = max(measurement_size(decider.n), command_size(decider.n)) + 1

    def close(self) -> None:
        """Let go of the address."""
        self._socket.close()

    def take(self, data: bytes, sender: tuple[str, int]) -> bytes | None:
        """The answer to bytes from somebody; None: there is none."""
        found = self._accepted(data, sender)
        return None if found is None else self._answer(found)

    def _accepted(self, data: bytes, sender: tuple[str, int]) -> Measurement | None:
        """The measurement that bytes are, if it is one that counts."""
        found = unpack_measurement(data, self._decider.n)
        if found is None or not math.isfinite(found.time):
            self.counts["wrong"] += 1
        elif self._peer not in (None, sender):
            self.counts["foreign"] += 1
        elif self._last is not None and not newer(found.sequence, self._last.sequence):
            self.counts["old"] += 1
        else:
            self._peer, self._last = sender, found
            return found
        return None

    def _answer(self, found: Measurement) -> bytes:
        self.counts["answered"] += 1
        if self._resting:
            return self._brake()
        began = time.thread_time()  # not what it waits for other processes
        try:
            answer = pack_command(self._decider.answer(found))
            self._spent.append(time.thread_time() - began)
            return answer
        except (PCRError, ValueError) as error:
            self.problem = str(error)
            self.counts["failures"] += 1
            self._resting = True
            return self._brake()

    def wait(self) -> bytes | None:
        """The command of one more period of silence; None where nobody is served."""
        if self._peer is None:
            return None
        if not self._resting:
            self._resting = True
            self.counts["rests"] += 1
        return self._brake()

    def _brake(self) -> bytes:
        """Command of a period in which the motors come to rest; where they are, whoever comes next is served."""
        assert self._last is not None
        command = self._decider.rest(self._last.sequence, self._last.time)
        if at_rest(command):
            self._decider.stop()
            self._peer, self._last, self._resting = None, None, False
        return pack_command(command)

    def serve(self, tell: Callable[[str], None] = print, *, until: Callable[[], bool] = lambda: False) -> None:
        """Serve until Ctrl-C; ``until`` is asked now and then."""
        period, heard = self._decider.period, time.monotonic()
        asked = -_ASKED
        while True:
            interrupt.check()
            if (now := time.monotonic()) - asked >= _ASKED:
                asked = now
                if until():
                    return
            left = (
                period
                if self._peer is None
                else heard + period * (1 if self._resting else self._silence) - time.monotonic()
            )
            # Looked at in every round: packets of others do not break a silence.
            if left <= 0.0:
                peer, began, heard = self._peer, not self._resting, time.monotonic()
                self._send(self.wait(), peer)
                if began:
                    tell(f"nothing measured for {self._silence} periods: the motors are brought to rest")
                continue
            for found in self._waiting(min(period, left)):
                peer, failures, heard = self._peer, self.counts["failures"], time.monotonic()
                self._send(self._answer(found), peer)
                if self.counts["failures"] > failures:
                    tell(f"no answer, the motors are brought to rest: {self.problem}")

    def _waiting(self, wait: float) -> list[Measurement]:
        """Measurements that have come and are to be answered, waiting for the first.

        A controller that knows all measurements, late as they may be, is in time again after a burst; one that is too
        slow for that answers the last alone.
        """
        found: list[Measurement] = []
        if not select.select([self._socket], [], [], wait)[0]:
            return found
        for _ in range(_QUEUE):
            try:
                data, sender = self._socket.recvfrom(self._size)
            except OSError:  # nobody has spoken; or nobody has taken the last answer, which some systems tell here
                break
            later = self._accepted(data, sender[:2])
            if later is not None:
                found.append(later)
        if len(found) < 2 or min(self._spent) < self._decider.period * _QUICK:
            return found
        self.counts["skipped"] += len(found) - 1
        return found[-1:]

    def _send(self, answer: bytes | None, peer: tuple[str, int] | None) -> None:
        if answer is None or peer is None:
            return
        try:
            self._socket.sendto(answer, peer)
        except OSError:
            self.counts["unsent"] += 1
