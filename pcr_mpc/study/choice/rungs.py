"""The ladder of physics: what a scene's plant may leave out, from the paper's model upwards.

A rung is how a plant is simulated (`PlantSettings`): one level on each of the ladders that matter to the scene, and a
discretisation.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

from ...loop.hardware.motors import IDEAL
from ...loop.scene.scene import Scene
from ...loop.scene.settings import MOTORS, PAYLOADS, RODS, PlantSettings
from ...plant.rods.closed_form.inertia import INERTIAS
from ...plant.statics.weight import WEIGHTS

# Steps in a control period: some, for what happens within it, such as a late decision. Force evaluations a step, which
# is what a step costs.
STEPS_PER_PERIOD = (5, 10, 20, 40)
FORCES_PER_STEP = {"semi_implicit_euler": 1, "velocity_verlet": 1, "rk4": 4, "gauss": 1}
# Segments, steps in each and scheme of multiple shooting: time of a force, relative. The last is as good as exact.
SHOOTINGS = {(4, 2, "rk4"): 1.0, (4, 1, "rk8"): 1.5, (8, 1, "rk8"): 2.5}
LADDERS = "inertia", "weight", "rods", "payload", "motors"
BEST_SHOOTING = list(SHOOTINGS)[-1]


def ladders(scene: Scene) -> dict[str, tuple[str, ...]]:
    """Levels of each effect that the scene has, lowest first."""
    robot = scene.robot
    heavy = any(rod.line_density for rod in robot.rods)
    return {
        "inertia": INERTIAS if heavy else INERTIAS[:1],
        "weight": WEIGHTS if heavy and any(robot.gravity) else WEIGHTS[:1],
        "rods": RODS if robot.plain() != robot else RODS[-1:],
        "payload": PAYLOADS if scene.payload is not None else PAYLOADS[-1:],
        "motors": MOTORS if scene.motors not in (None, IDEAL) else MOTORS[-1:],
    }


def levels(rung: PlantSettings) -> dict[str, str]:
    """Level of a rung on each ladder."""
    return {name: str(getattr(rung, name)) for name in LADDERS}


def named(scene: Scene, rung: PlantSettings) -> str:
    """Physics of a rung in words: its levels on the ladders that the scene has."""
    own, steps = levels(rung), ladders(scene)
    return ", ".join(f"{name} {own[name]}" for name in own if len(steps[name]) > 1)


def height(scene: Scene, rung: PlantSettings) -> int:
    """How many levels up a rung is, all ladders together."""
    own = levels(rung)
    return sum(steps.index(own[name]) for name, steps in ladders(scene).items())


def all_physics(scene: Scene, dt: float) -> list[PlantSettings]:
    """Every combination of levels, lowest first, each with the best discretisation at time step ``dt`` [s]."""
    found = []
    for chosen in product(*ladders(scene).values()):
        inertia, weight, rods, payload, motors = chosen
        plain = rods == RODS[0] or scene.robot.plain() == scene.robot
        segments, steps, scheme = BEST_SHOOTING
        rung = PlantSettings(
            method="closed_form" if plain and weight != "exact" else "multiple_shooting",
            segments=segments, steps=steps, scheme=scheme,
            integrator="gauss" if inertia == "full" else "rk4", dt=dt, on_snap="raise",
            inertia=inertia, weight=weight, rods=rods, payload=payload, motors=motors,
        )  # fmt: skip
        found.append(rung)
    return sorted(found, key=lambda rung: height(scene, rung))


def discretisations(scene: Scene, rung: PlantSettings) -> list[PlantSettings]:
    """The same physics with every integrator, time step and discretisation of the rods, the cheapest first."""
    integrators = ["gauss"] if rung.inertia == "full" else [name for name in FORCES_PER_STEP if name != "gauss"]
    shootings = {BEST_SHOOTING: 1.0} if rung.method == "closed_form" else SHOOTINGS
    found = []
    for integrator, parts, (shooting, cost) in product(integrators, STEPS_PER_PERIOD, shootings.items()):
        segments, steps, scheme = shooting
        other = replace(
            rung, integrator=integrator, dt=scene.period / parts, segments=segments, steps=steps, scheme=scheme
        )
        found.append((FORCES_PER_STEP[integrator] * parts * cost, other))
    return [other for _, other in sorted(found, key=lambda pair: pair[0])]
