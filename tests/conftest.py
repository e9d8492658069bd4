from pathlib import Path

import numpy as np
import pytest

from pcr_mpc import Equilibrium, Robot, inverse_statics, load_robot, solve_statics

ROOT = Path(__file__).parent.parent
MODELS = ROOT / "models"
CONTROLLERS = ROOT / "controllers"
DATA = Path(__file__).parent / "data"


@pytest.fixture(scope="session")
def pair() -> Robot:
    return load_robot(MODELS / "planar_pair.toml")


@pytest.fixture(scope="session")
def rfrfr() -> Robot:
    return load_robot(MODELS / "rfrfr.toml")


@pytest.fixture(scope="session")
def centre(pair: Robot) -> Equilibrium:
    """The default robot in balance at (0, 0.25), rods bowed outward."""
    return inverse_statics(pair, (0.0, 0.25), mode="LR")


@pytest.fixture(scope="session")
def poses(pair: Robot, centre: Equilibrium) -> list[Equilibrium]:
    """Poses away from balance around the centre, on its branch."""
    rng = np.random.default_rng(7)
    found = []
    for _ in range(5):
        p = centre.p + rng.uniform(-0.06, 0.06, 2)
        q = centre.q + rng.uniform(-0.4, 0.4, 2)
        found.append(solve_statics(pair, p, q, guess=centre))
    return found


def random_pose(robot: Robot, rng: np.random.Generator, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """A tip within ``reach`` of every rod's length and motor angles within their limits."""
    low = (robot.bases - robot.lengths[:, None]).min(axis=0)
    high = (robot.bases + robot.lengths[:, None]).max(axis=0)
    while True:
        p = rng.uniform(low, high)
        if (np.linalg.norm(p - robot.bases, axis=1) < reach * robot.lengths).all():
            return p, rng.uniform(*robot.angle_limits.T)
