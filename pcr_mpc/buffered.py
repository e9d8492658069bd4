"""Graphs, which all may share, and the memory that they are called through, which belongs to one caller."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import lru_cache, wraps
from itertools import pairwise
from operator import is_
from typing import Any, NoReturn, ParamSpec, TypeVar, cast

import casadi as ca
import numpy as np

P = ParamSpec("P")
R = TypeVar("R")

# Evaluating graphs in many threads is safe, building them is not: CasADi lets go of Python's lock meanwhile, and its
# expressions share what they are made of.
BUILDING = threading.RLock()


def building(build: Callable[P, R]) -> Callable[P, R]:
    """Let one thread at a time in: for functions that build graphs."""

    @wraps(build)
    def locked(*args: P.args, **kwargs: P.kwargs) -> R:
        with BUILDING:
            return build(*args, **kwargs)

    return locked


def graph_cache(maxsize: int = 128) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """As `functools.lru_cache`, for what builds graphs: one thread at a time does."""

    def decorate(build: Callable[P, R]) -> Callable[P, R]:
        return building(lru_cache(maxsize)(build))

    return decorate


class _Local(threading.local):
    """What a thread has made, and the last of it."""

    cached: Any = None
    args: tuple[Any, ...] = (object(),)  # of no call
    found: Any = None


def per_thread(maxsize: int = 128) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """As `functools.lru_cache`, but every thread has its own: for functions that need memory to write into.

    What is made is for the call that asked for it. An object that lives longer makes its own: it may be called by
    another thread than the one that made it.
    """

    def decorate(make: Callable[P, R]) -> Callable[P, R]:
        local = _Local()

        @wraps(make)
        def own(*args: P.args, **kwargs: P.kwargs) -> R:
            # Mostly it is the same call as the last, and to hash a robot takes longer than to see that.
            if len(args) == len(local.args) and not kwargs and all(map(is_, args, local.args)):
                return cast(R, local.found)
            if local.cached is None:
                local.cached = lru_cache(maxsize)(make)
            found: R = local.cached(*args, **kwargs)
            if not kwargs:
                local.args, local.found = args, found
            return found

        return own

    return decorate


class BufferedFunction:
    """A CasADi function bound to NumPy memory that it reads and writes in place: 1-3 us a call instead of 35-50 us.

    ``inputs[i]`` and ``outputs[i]`` are Fortran-ordered views of that memory: write the inputs
    with ``[...] =``, call the object, read (and copy, if kept) the outputs. All inputs lie one after the other in
    ``memory_in``, all outputs in ``memory_out``: one copy takes along what belongs together. It belongs to one caller
    at a time.

    Parameters
    ----------
    function : casadi.Function
        Its arguments and results are made dense, so that views have the full shapes.
    """

    def __init__(self, function: Any) -> None:
        self.function = function = dense(function)
        self.memory_in, of_inputs = _memory([function.size_in(i) for i in range(function.n_in())])
        self.memory_out, of_outputs = _memory([function.size_out(i) for i in range(function.n_out())])
        # The buffer object owns the work memory: losing it while `_trigger` lives is a segfault.
        self._buffer, self._trigger = function.buffer()
        for i, memory in enumerate(of_inputs):
            self._buffer.set_arg(i, memoryview(memory.data))
        for i, memory in enumerate(of_outputs):
            self._buffer.set_res(i, memoryview(memory.data))
        self.inputs = [_view(m, function.size_in(i)) for i, m in enumerate(of_inputs)]
        self.outputs = [_view(m, function.size_out(i)) for i, m in enumerate(of_outputs)]

    def __call__(self) -> None:
        """Evaluate: reads ``inputs``, overwrites ``outputs``."""
        self._trigger()

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            f"the graph {self.function.name()!r} writes into memory of its own, and can be neither pickled nor copied: "
            "pickle the plant, controller or model that it belongs to, or make that anew"
        )


@building
def dense(function: Any) -> Any:
    """Return the same function with all its arguments and results dense; itself if they are."""
    if _all_dense(function.sparsity_in, function.n_in()) and _all_dense(function.sparsity_out, function.n_out()):
        return function
    symbol = ca.SX if function.is_a("SXFunction") else ca.MX
    arguments = [symbol.sym(f"i{i}", *function.size_in(i)) for i in range(function.n_in())]
    results = [ca.densify(result) for result in function.call(arguments)]
    return ca.Function(function.name(), arguments, results, function.name_in(), function.name_out())


@building
def listed(function: Any) -> Any:
    """Return the same function as one list of instructions, without calls: a fifth faster where it is interpreted.

    CasADi simplifies nothing meanwhile, lest the last digits are others than with the calls.
    """
    simplifies = ca.GlobalOptions.getSimplificationOnTheFly()
    ca.GlobalOptions.setSimplificationOnTheFly(False)
    try:
        return function.expand(function.name())
    finally:
        ca.GlobalOptions.setSimplificationOnTheFly(simplifies)


def _all_dense(sparsity: Any, count: int) -> bool:
    return all(sparsity(i).is_dense() for i in range(count))


def _memory(shapes: list[tuple[int, int]]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Memory for matrices of these shapes, and the part of each."""
    ends = np.cumsum([0, *(rows * columns for rows, columns in shapes)]).tolist()
    memory = np.zeros(ends[-1])
    return memory, [memory[first:last] for first, last in pairwise(ends)]


def _view(memory: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    rows, columns = shape
    return memory if columns == 1 else memory.reshape(rows, columns, order="F")
