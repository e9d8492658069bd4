"""The two packets of the loop over UDP; docs/wire.md has them as tables.

All is little-endian, without gaps. A packet ends with the CRC-32 (zlib's) of all bytes before it, and has one size for
a number of motors n: whatever has another size, another magic, version, kind or checksum is none of ours.
"""

from __future__ import annotations

import struct
import zlib
from typing import NamedTuple

import numpy as np

MAGIC, VERSION = b"PCR\x01", 1
MEASUREMENT, COMMAND = 1, 2
# Beyond the rungs of the ladder (see `vectors.RUNGS`): the motors are brought to rest, for silence or a failure.
RESTING = 5
_HEAD = struct.Struct("<4sHBBId")  # magic, version, kind, n, sequence, time stamp
_ANSWER = struct.Struct("<BBH")  # rung, doubts, iterations
_CHECK = struct.Struct("<I")
_WRAP = 1 << 32


class Measurement(NamedTuple):
    """From the robot: what its sensors say.

    Attributes
    ----------
    sequence : int
        One more with each packet, modulo 2^32.
    time : float
        On the sender's clock [s].
    p : ndarray, shape (2,)
        Tip [m]; NaN if it was not measured.
    q : ndarray, shape (n,)
        Motor angles [rad]; NaN if they were not.
    """

    sequence: int
    time: float
    p: np.ndarray
    q: np.ndarray


class Command(NamedTuple):
    """To the robot: what its motors are to do.

    Attributes
    ----------
    sequence, time : int, float
        Of the measurement that it answers, or of the last one while the motors are brought to rest.
    u : ndarray, shape (n,)
        Motor rates [rad/s].
    rung : int
        Which rung of the ladder has answered: 0 solved, 1 softened, 2 shifted plan, 3 LQR, 4 hold; or `RESTING`.
    doubts : int
        1: the tip was not believed, 2: the angles were not.
    iterations : int
        Of the solver.
    stiffness : float
        Least eigenvalue of the robot's stiffness [N/m]; how far it is from snapping.
    torque : ndarray, shape (n,)
        Of the motors [N m].
    """

    sequence: int
    time: float
    u: np.ndarray
    rung: int
    doubts: int = 0
    iterations: int = 0
    stiffness: float = float("nan")
    torque: np.ndarray = np.zeros(0)


def measurement_size(n: int) -> int:
    """Bytes of a measurement of n motors."""
    return _HEAD.size + 8 * (2 + n) + _CHECK.size


def command_size(n: int) -> int:
    """Bytes of a command for n motors."""
    return _HEAD.size + _ANSWER.size + 8 * (1 + 2 * n) + _CHECK.size


def pack_measurement(found: Measurement) -> bytes:
    """Bytes of a measurement."""
    n = len(found.q)
    head = _HEAD.pack(MAGIC, VERSION, MEASUREMENT, n, found.sequence % _WRAP, found.time)
    return _signed(head + _doubles([*found.p, *found.q]))


def pack_command(command: Command) -> bytes:
    """Bytes of a command."""
    n = len(command.u)
    torque = command.torque if len(command.torque) == n else np.full(n, np.nan)
    head = _HEAD.pack(MAGIC, VERSION, COMMAND, n, command.sequence % _WRAP, command.time)
    answer = _ANSWER.pack(command.rung, command.doubts, min(command.iterations, 65535))
    return _signed(head + answer + _doubles([*command.u, command.stiffness, *torque]))


def unpack_measurement(data: bytes, n: int) -> Measurement | None:
    """A measurement of n motors, or None if the bytes are no such packet."""
    head = _opened(data, MEASUREMENT, n, measurement_size(n))
    if head is None:
        return None
    values = np.frombuffer(data, "<f8", 2 + n, _HEAD.size).astype(float)
    return Measurement(*head, values[:2], values[2:])


def unpack_command(data: bytes, n: int) -> Command | None:
    """A command for n motors, or None if the bytes are no such packet."""
    head = _opened(data, COMMAND, n, command_size(n))
    if head is None:
        return None
    rung, doubts, iterations = _ANSWER.unpack_from(data, _HEAD.size)
    values = np.frombuffer(data, "<f8", 1 + 2 * n, _HEAD.size + _ANSWER.size).astype(float)
    return Command(*head, values[:n], rung, doubts, iterations, float(values[n]), values[n + 1 :])


def newer(sequence: int, last: int) -> bool:
    """Whether a packet comes after the last one, the sequence running round."""
    return 0 < (sequence - last) % _WRAP < _WRAP // 2


def _doubles(values: list[float]) -> bytes:
    return struct.pack(f"<{len(values)}d", *values)


def _signed(data: bytes) -> bytes:
    return data + _CHECK.pack(zlib.crc32(data))


def _opened(data: bytes, kind: int, n: int, size: int) -> tuple[int, float] | None:
    """Sequence and time stamp of a packet, if it is one of this kind."""
    if len(data) != size or _CHECK.unpack_from(data, size - _CHECK.size)[0] != zlib.crc32(data[: -_CHECK.size]):
        return None
    magic, version, found, motors, sequence, time = _HEAD.unpack_from(data)
    if (magic, version, found, motors) != (MAGIC, VERSION, kind, n):
        return None
    return int(sequence), float(time)
