"""The planner's linear programs, that grow and go on from their last basis, against SciPy's solved anew."""

import numpy as np
import pytest
from scipy.optimize import linprog

from pcr_mpc import ConvergenceError
from pcr_mpc.study.planning.along_path.program import LinearProgram


def test_a_program_that_grows_has_the_optimum_of_one_solved_anew(capfd):
    rng = np.random.default_rng(1)
    costs, columns = rng.normal(size=12), np.stack([rng.choice(12, 4, replace=False) for _ in range(60)])
    values, high = rng.normal(size=columns.shape), rng.uniform(0.2, 1.0, 60)
    dense = np.zeros((60, 12))
    np.put_along_axis(dense, columns, values, axis=1)
    program, count = LinearProgram(costs), 0
    for rows, width in ((10, 1.0), (60, 1.0), (60, 0.5)):
        program.bound(np.full(12, -width), np.full(12, width))
        new = slice(count, rows)
        program.add_rows(np.full(rows - count, -np.inf), high[new], columns[new], values[new])
        count = rows
        for scale in (1.0, 0.7):
            program.bound_rows(np.full(rows, -np.inf), scale * high[:rows])
            anew = linprog(costs, dense[:rows], scale * high[:rows], bounds=[(-width, width)] * 12)
            x = program.solved()
            assert costs @ x == pytest.approx(anew.fun, abs=1e-9)
            assert (dense[:rows] @ x <= scale * high[:rows] + 1e-9).all()
    # Another program that begins at this one's answer has all its rows in the end, and its own optimum.
    held = program.held()
    assert 0 < held.sum() <= 12
    assert dense[held] @ x == pytest.approx(0.7 * high[held])
    other_costs = costs + rng.normal(scale=0.3, size=12)
    other = LinearProgram(other_costs)
    other.bound(np.full(12, -0.5), np.full(12, 0.5))
    for rows in (held, ~held):
        other.add_rows(np.full(rows.sum(), -np.inf), high[rows], columns[rows], values[rows])
        if rows is held:
            other.begin_as(program)
            assert other.held().all()
    anew = linprog(other_costs, dense, high, bounds=[(-0.5, 0.5)] * 12)
    assert other_costs @ other.solved() == pytest.approx(anew.fun, abs=1e-9)
    program.bound_rows(np.full(60, 1e3), np.full(60, np.inf))
    with pytest.raises(ConvergenceError, match="not solved: Infeasible"):
        program.solved()
    assert capfd.readouterr().out == ""  # of a command whose output is JSON
