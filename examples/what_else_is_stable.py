"""Every pose to which a robot could snap with its motors as they are, and how far it may move before a fold."""

import numpy as np

from pcr_mpc import all_equilibria, distance_to_fold, inverse_statics, load_robot, shipped

robot = load_robot(shipped("planar_pair", "robot"))
rest = inverse_statics(robot, (0.0, 0.25), mode="LR")

for eq in all_equilibria(robot, q=rest.q):
    print(
        f"{'stable  ' if eq.stable else 'unstable'} {eq.mode}  tip at {np.round(1e3 * eq.p, 1)} mm, {eq.energy:.3f} J"
    )

for turn in ((1.0, -1.0), (-2.0, 2.0)):
    share = distance_to_fold(rest, rest.p, rest.q + turn)
    print(f"tip held, motors turned by {turn} rad: stable on {100 * share:.0f} % of the way")
