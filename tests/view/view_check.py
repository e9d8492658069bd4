"""Where a tip rests on a spring, by the statics alone: no plant, no motion."""

import numpy as np

from pcr_mpc.plant.statics.free_tip import forward_statics


def spring_balance(robot, start, stiffness, end, steps=20):
    """Tip of a free pose under F(p) = stiffness (end - p), followed from ``start`` by Newton's method, shape (2,)."""
    p, pose = start.p.copy(), start
    for k in range(1, steps + 1):
        goal = start.p + k / steps * (end - start.p)
        for _ in range(20):
            pose = forward_statics(robot, start.q, force=stiffness * (goal - p), guess=pose)
            if np.abs(pose.p - p).max() < 1e-10:
                break
            # The free tip under the spring's force at p is a map of p, whose fixed point is looked for.
            slope = np.linalg.inv(pose.dforce_dp)
            p = p + np.linalg.solve(np.eye(2) + stiffness * slope, pose.p - p)
        else:
            raise AssertionError(f"no balance found on the way to {end}")
    return p
