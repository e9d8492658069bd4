"""Scenes, closed-loop simulation and its record.

Rooms, each of which may import from those before it: `references` (trajectories of the tip) and `hardware` (motors and
cameras that are not ideal), `scene` (which robot does what), `demand` (what a reference asks of the robot), `parts`
(what a control step is made of), `live` (references that change on the fly) and `learning` (from lap to lap),
`controller`, and `run` (the closed loop and its record).
"""
