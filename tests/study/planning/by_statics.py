"""The motors of a planned motion, found another way."""

from pcr_mpc import inverse_statics


def motors(robot, trajectory, t, pose):
    """Angles at equally spaced times, by inverse statics of the forces that the motion takes."""
    samples = trajectory(t)
    forces = -robot.tip_mass * samples[:, 2] - robot.drag * samples[:, 1]
    found = []
    for p, force in zip(samples[:, 0], forces, strict=True):
        pose = inverse_statics(robot, p, force, guess=pose)
        found.append(pose)
    return found
