import os

# Before numpy is loaded, here and in what inherits from here: every core has a worker of its own, and threads of small
# matrices would wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import hypothesis
import numpy as np
import pytest

from pcr_mpc import Equilibrium, LinearModel, Plant, Robot, inverse_statics, linearise, load_robot, solve_statics

ROOT = Path(__file__).parent.parent
MODELS = ROOT / "models"
CONTROLLERS = ROOT / "controllers"
DATA = Path(__file__).parent / "data"
# Nothing is compiled, by subprocesses neither, but in tests that ask for the compiler.
# Workers of a run on all cores inherit what is set here, and look for the compiler in the other variable.
COMPILER = os.environ.setdefault("COMPILER_OF_TESTS", os.environ.get("CC", "cc"))
os.environ["CC"] = ""
# A busy machine is no failure of what is tested.
hypothesis.settings.register_profile(
    "any machine", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("any machine")


@pytest.fixture(scope="session")
def machine_code(tmp_path_factory) -> Path:
    """Cache folder of this test run."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def compiler(monkeypatch, machine_code) -> str:
    """The machine's C compiler."""
    if not COMPILER or shutil.which(shlex.split(COMPILER)[0]) is None:
        pytest.skip("no C compiler")
    monkeypatch.setenv("CC", COMPILER)
    monkeypatch.setenv("XDG_CACHE_HOME", str(machine_code))
    return COMPILER


@pytest.fixture
def quick_storage():
    """Studies of this process wait for no disk: what a test stores need not outlive the machine."""
    event, engine = pytest.importorskip("sqlalchemy").event, pytest.importorskip("sqlalchemy.engine").Engine

    def unsafe(connection, _):
        connection.execute("PRAGMA synchronous = OFF")
        connection.execute("PRAGMA journal_mode = MEMORY")

    event.listen(engine, "connect", unsafe)
    yield
    event.remove(engine, "connect", unsafe)


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
def target(centre: Equilibrium) -> np.ndarray:
    """State at rest in the centre."""
    return np.concatenate([centre.p, np.zeros(2), centre.q])


@pytest.fixture(scope="session")
def model(pair: Robot, centre: Equilibrium, target: np.ndarray) -> LinearModel:
    """About the centre, for a period of 10 ms."""
    plant = Plant(pair)
    plant.reset(target, centre)
    return linearise(plant, target, np.zeros(2), 0.01)


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


@pytest.fixture(scope="session")
def general(pair: Robot) -> Robot:
    """Weight, curvature, varying stiffness and stretch at once, and different for the two rods."""
    rods = (
        replace(pair.rods[0], curvature=(0.5, 1.0, 0.3), stiffness_factors=(1.2, 1.0, 0.7), axial_stiffness=5e3),
        replace(pair.rods[1], curvature=-0.8, stiffness_factors=(1.0, 0.8), line_density=0.1),
    )
    return replace(pair, gravity=(2.0, -9.81), rods=rods)


@pytest.fixture(scope="session")
def bent(general: Robot) -> Equilibrium:
    return solve_statics(general, (0.01, 0.24), (3.2, 0.1))


@pytest.fixture(scope="session")
def knotted(general: Robot) -> Robot:
    """General rods that both stretch, with as many values along them as there are knots."""
    rods = general.rods
    other = replace(rods[1], curvature=(-0.8, -0.9, -0.7), stiffness_factors=(1.0, 0.9, 0.8), axial_stiffness=7e3)
    return replace(general, rods=(rods[0], other))


@pytest.fixture(scope="session")
def inextensible(general: Robot) -> Robot:
    """The general rods but for their stretch."""
    return replace(general, rods=tuple(replace(rod, axial_stiffness=np.inf) for rod in general.rods))


@pytest.fixture(scope="session")
def heavy() -> Robot:
    return load_robot(MODELS / "heavy_pair.toml")


@pytest.fixture(scope="session")
def sagging(heavy: Robot) -> Equilibrium:
    return inverse_statics(heavy, (0.0, 0.25), mode="LR")


def random_pose(robot: Robot, rng: np.random.Generator, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """A tip within ``reach`` of every rod's length and motor angles within their limits."""
    low = (robot.bases - robot.lengths[:, None]).min(axis=0)
    high = (robot.bases + robot.lengths[:, None]).max(axis=0)
    while True:
        p = rng.uniform(low, high)
        if (np.linalg.norm(p - robot.bases, axis=1) < reach * robot.lengths).all():
            return p, rng.uniform(*robot.angle_limits.T)
