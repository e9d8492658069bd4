"""As fast as the robot can: the timing of a path, and the path between way-points.

`path` takes the geometry, `course` gives it a nominal pace, `motion` and `angles` say what a faster one asks of the
motors and how that changes, `limits` holds it against what there is, `timing` is all that together; `starting` finds
one to begin with, `fastest` improves it, `plan` does all of it.
"""
