"""Packets: the bytes that the page has, and what is none."""

import struct
import zlib

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pcr_mpc.wire.packet import (
    Command,
    Measurement,
    command_size,
    measurement_size,
    newer,
    pack_command,
    pack_measurement,
    unpack_command,
    unpack_measurement,
)
from tests.wire.packets import measurement

doubles = st.floats(allow_nan=True, allow_infinity=True)


@given(st.integers(0, 2**32 - 1), doubles, st.lists(doubles, min_size=2, max_size=2), st.lists(doubles, max_size=4))
def test_a_measurement_arrives_as_it_was_sent(sequence, time, p, q):
    data = pack_measurement(Measurement(sequence, time, np.array(p), np.array(q)))
    assert len(data) == measurement_size(len(q))
    found = unpack_measurement(data, len(q))
    assert found.sequence == sequence
    assert np.array_equal([found.time, *found.p, *found.q], [time, *p, *q], equal_nan=True)
    assert unpack_measurement(data, len(q) + 1) is None
    assert unpack_command(data, len(q)) is None


def test_the_bytes_are_those_of_the_page():
    # Written out here: little-endian, no gaps, the checksum last.
    body = struct.pack("<4sHBBId4d", b"PCR\x01", 1, 1, 2, 7, 0.07, 0.01, 0.25, 3.4, -0.2)
    expected = body + struct.pack("<I", zlib.crc32(body))
    assert measurement(7, (0.01, 0.25), (3.4, -0.2), 0.07) == expected
    assert len(expected) == 56
    body = struct.pack("<4sHBBIdBBH5d", b"PCR\x01", 1, 2, 2, 7, 0.07, 1, 2, 30, 0.5, -0.5, 80.0, 0.1, 0.2)
    command = Command(7, 0.07, np.array([0.5, -0.5]), 1, 2, 30, 80.0, np.array([0.1, 0.2]))
    assert pack_command(command) == body + struct.pack("<I", zlib.crc32(body))
    assert command_size(2) == 68


@given(st.integers(0, 55), st.integers(1, 255))
def test_one_changed_byte_is_found(place, change):
    data = bytearray(measurement(1))
    data[place] ^= change
    assert unpack_measurement(bytes(data), 2) is None


def test_the_sequence_runs_round():
    assert newer(0, 2**32 - 1)
    assert not newer(2**32 - 1, 0)
    assert not newer(3, 3)
