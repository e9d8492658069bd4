"""Studies: each answers one question, by measurement."""

import os

# The matrices are small: on two cores more threads make SciPy's solvers ten times slower when something else runs.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
