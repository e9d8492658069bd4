"""Packets of tests."""

import numpy as np

from pcr_mpc.wire.packet import Measurement, pack_measurement

ME, OTHER = ("127.0.0.1", 40001), ("127.0.0.1", 40002)


def measurement(sequence, p=(3.0, 0.0), q=(1.0, 2.0), time=0.0):
    return pack_measurement(Measurement(sequence, time, np.array(p), np.array(q)))
