"""A hand-drawn path, and the truth behind it: models/scenes/hand_drawn.csv is made of it."""

import numpy as np

SEED, NOISE, COUNT = 14, 5e-4, 150  # m, of each coordinate; rows at about 30 Hz
HEADER = """\
# A loop drawn by an unsteady hand at about 30 Hz: noise of 0.5 mm, times that jitter by 3 ms,
# rounded to 0.1 mm and 1 ms.
# Made by tests/references/drawn.py with seed 14; a test compares.
"""


def truth(t):
    """Where the hand wanted to be at the times t [s], (len(t), 2) [m]."""
    u = np.asarray(t) / 5.0
    phi = 2 * np.pi * u
    x = 0.05 * (2 * u - 1) + 0.025 * np.sin(2 * phi)
    y = 0.245 + 0.025 * np.cos(2 * phi) + 0.008 * np.sin(phi)
    return np.stack([x, y], axis=1)


def rows():
    """Times and noisy positions, as they stand in the file."""
    rng = np.random.default_rng(SEED)
    t = np.arange(COUNT) / 30 + rng.uniform(-3e-3, 3e-3, COUNT)
    t = np.round(t - t[0], 3)
    return t, np.round(truth(t) + rng.normal(0.0, NOISE, (COUNT, 2)), 4)


def text():
    t, points = rows()
    lines = [f"{a:.3f},{x:.4f},{y:.4f}\n" for a, (x, y) in zip(t, points, strict=True)]
    return HEADER + "t_s,x_m,y_m\n" + "".join(lines)
