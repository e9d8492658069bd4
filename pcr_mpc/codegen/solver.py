"""What C must know of the QPs beforehand: their sizes, and the order in which OSQP eliminates their KKT matrices."""

from __future__ import annotations

import importlib.metadata
import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import osqp
import scipy.sparse as sp

from ..control.qp.limited import soft_pattern
from ..control.qp.program import constraint_matrix
from ..errors import GenerationError


@dataclass(frozen=True, eq=False)
class Shape:
    """Of one QP; what ``pcr_qp_shape`` holds.

    Attributes
    ----------
    matrix : scipy.sparse.csc_matrix, shape (m, n)
        Pattern and first values of A.
    identity : bool
        Whether P is the identity; else its whole upper triangle is stored.
    order : ndarray of int, shape (n + m,)
        Elimination order of the KKT matrix.
    factor : int
        Entries of its factor.
    """

    matrix: sp.csc_matrix
    identity: bool
    order: np.ndarray
    factor: int

    @property
    def sizes(self) -> tuple[int, int, int, int, int]:
        """Columns n, rows m, entries of P, of A, and of the KKT matrix."""
        m, n = self.matrix.shape
        of_p = n if self.identity else n * (n + 1) // 2
        return n, m, of_p, self.matrix.nnz, of_p + self.matrix.nnz + m

    @property
    def doubles(self) -> int:
        """Memory that ``pcr_qp_setup`` takes [doubles]."""
        n, m, of_p, of_a, of_k = self.sizes
        iterates = 10 * n + 13 * m + 6 * (n + m)
        scaling = 0 if self.identity else 4 * n + 3 * m
        return of_p + of_a + of_k + self.factor + iterates + scaling

    @property
    def ints(self) -> int:
        """Memory that ``pcr_qp_setup`` takes [ints]."""
        n, m, of_p, of_a, of_k = self.sizes
        patterns = (n + 1) + 2 * (n + m + 1) + of_p + of_k + self.factor
        return patterns + 9 * (n + m) + of_p + 3 * of_a + 3 * m + 1


def flops(shape: Shape, solver: str, inputs: int) -> int:
    """Floating-point operations of an iteration: OSQP solves with its factor; DAQP looks at all rows, and updates a
    factor of those that are active."""
    n, m, _, of_a, _ = shape.sizes
    if solver == "osqp":
        return 4 * (shape.factor + of_a + n + m)
    return 2 * of_a + 4 * ((n + inputs) // 2 if shape.identity else n) ** 2


def daqp_room(shape: Shape, inputs: int) -> tuple[int, int]:
    """Memory that ``pcr_qp_setup`` takes for DAQP [doubles], [ints]; it is told no slacks of soft rows."""
    n, m, *_ = shape.sizes
    soft = (n - inputs) // 2 if shape.identity else 0
    rows, most = m - 2 * soft, inputs + soft + 1
    bounds = 0 if soft else inputs
    handed = 2 * n + 3 * m + rows + inputs**2 + (rows - bounds) * inputs
    iterates = 5 * most + most * (most + 1) // 2 + 2 * inputs
    problem = 3 * rows + (rows - bounds) * (inputs + 1) + inputs * (inputs + 1) // 2 + inputs
    return handed + iterates + problem + (4 * rows if soft else 0), most + inputs + 3 * rows


def rates_shape(horizon: int, n: int) -> Shape:
    """The QP that knows the limits on rates and their changes alone."""
    matrix = constraint_matrix(horizon, n)[: 2 * horizon * n].tocsc()
    matrix.sort_indices()
    size = horizon * n
    return _shape(matrix, sp.triu(np.ones((size, size)), format="csc"), identity=False)


def limited_shapes(horizon: int, n: int, rows: Sequence[int]) -> list[Shape]:
    """The QPs with soft rows, one for each combination of kinds of limits on poses that have so many rows each."""
    counts = [sum(row for k, row in enumerate(rows) if kinds >> k & 1) for kinds in range(1 << len(rows))]
    size = horizon * n
    made = {}
    for count in set(counts):
        matrix = soft_pattern(size, size + horizon * count)
        made[count] = _shape(matrix, sp.identity(matrix.shape[1], format="csc"), identity=True)
    return [made[count] for count in counts]


def sources() -> Path:
    """Folder of OSQP's own sources, which come with its wheel.

    Raises
    ------
    GenerationError
        They do not.
    """
    folder = Path(osqp.__file__).parent / "codegen" / "codegen_src"
    if not (folder / "src" / "osqp_api.c").is_file():
        raise GenerationError(f"{folder} has no sources of OSQP: this build of osqp came without them; install the "
                              "wheel of osqp 1.0 or later", part="solver")  # fmt: skip
    return folder


def licence() -> str:
    """OSQP's licence, as it comes with the wheel."""
    for file in importlib.metadata.files("osqp") or []:
        if file.name.upper().startswith("LICEN"):
            return file.read_text(encoding="utf-8")
    raise GenerationError("the installed osqp has no licence beside it; install its wheel", part="solver")


def _shape(matrix: sp.csc_matrix, hessian: sp.csc_matrix, *, identity: bool) -> Shape:
    order = _elimination_order(hessian, matrix)
    return Shape(matrix, identity, order, _factor_entries(hessian, matrix, order))


def _elimination_order(hessian: sp.csc_matrix, matrix: sp.csc_matrix) -> np.ndarray:
    """As OSQP's generator writes it down, from the patterns alone."""
    m, n = matrix.shape
    solver = osqp.OSQP()
    positive = sp.csc_matrix((np.full(hessian.nnz, 1e-3), hessian.indices, hessian.indptr), shape=hessian.shape)
    positive.setdiag(1.0)
    solver.setup(positive, np.zeros(n), matrix, -np.ones(m), np.ones(m), verbose=False, scaling=0)
    with tempfile.TemporaryDirectory() as folder:
        solver.codegen(folder, parameters="matrices", force_rewrite=True, extension_name=None,
                       include_codegen_src=False)  # fmt: skip
        written = (Path(folder) / "workspace.c").read_text()
    found = re.search(rf"linsys_P\[{n + m}\] = \{{([\s\d,]*)\}}", written)
    if found is None:
        raise GenerationError(f"osqp {osqp.__version__} writes its workspace in a way that is not known here; "
                              "install osqp 1.1", part="solver")  # fmt: skip
    return np.array([int(word) for word in found[1].replace(",", " ").split()])


def _factor_entries(hessian: sp.csc_matrix, matrix: sp.csc_matrix, order: np.ndarray) -> int:
    """Entries below the diagonal of the factor of the KKT matrix, counted column by column along its tree."""
    kkt: Any = sp.bmat([[hessian + hessian.T, matrix.T], [matrix, sp.identity(matrix.shape[0])]], format="csc")
    structure = sp.csc_matrix((np.ones(kkt.nnz), kkt.indices, kkt.indptr), shape=kkt.shape)[order][:, order].tocsc()
    size, parent, count = len(order), np.full(len(order), -1), 0
    for j in range(size):
        reached = {j}
        for i in structure.indices[structure.indptr[j] : structure.indptr[j + 1]]:
            while i < j and i not in reached:
                reached.add(i)
                count += 1
                if parent[i] < 0:
                    parent[i] = j
                i = parent[i]
    return count
