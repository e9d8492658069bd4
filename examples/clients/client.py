"""A robot's side of `pcr-mpc serve` in Python, with nothing but the standard library: python client.py HOST PORT."""

import socket
import struct
import sys
import time
import zlib
from contextlib import suppress

PERIOD, N = 0.01, 2  # s, motors
HEAD, ANSWER = "<4sHBBId", "<BBH"


def measurement(sequence, stamp, p, q):
    """Bytes of a measurement."""
    body = struct.pack(HEAD, b"PCR\x01", 1, 1, N, sequence, stamp) + struct.pack(f"<{2 + N}d", *p, *q)
    return body + struct.pack("<I", zlib.crc32(body))


def command(data):
    """Sequence, rung and rates; None for what is no command."""
    size = struct.calcsize(HEAD) + struct.calcsize(ANSWER) + 8 * (1 + 2 * N)
    if len(data) != size + 4 or struct.unpack("<I", data[size:])[0] != zlib.crc32(data[:size]):
        return None
    magic, version, kind, n, sequence, _ = struct.unpack_from(HEAD, data)
    if (magic, version, kind, n) != (b"PCR\x01", 1, 2, N):
        return None
    rung = data[struct.calcsize(HEAD)]
    return sequence, rung, struct.unpack_from(f"<{N}d", data, struct.calcsize(HEAD) + struct.calcsize(ANSWER))


def main(host, port, periods=10):
    """Ten periods of a robot that does what it is told."""
    q = [3.366835, -0.225243]  # your encoders [rad]; here motors that do what they are told
    p = [0.0, 0.25]  # your camera [m]; here a tip that stays
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.connect((host, int(port)))
        wire.settimeout(PERIOD)
        began = time.monotonic()
        for k in range(int(periods)):
            wire.send(measurement(k, time.monotonic() - began, p, q))
            found = None
            with suppress(OSError):  # no answer in time: keep the last rates for a few periods, then stop by yourself
                while not found or found[0] < k:  # what comes late is of an older measurement
                    found = command(wire.recv(512))
            if found and found[0] == k:
                print(k, "rung", found[1], "rates", *found[2])
                q = [angle + PERIOD * rate for angle, rate in zip(q, found[2], strict=True)]
            time.sleep(max(0.0, began + (k + 1) * PERIOD - time.monotonic()))


main(*sys.argv[1:])
