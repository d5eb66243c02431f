"""Linear algebra in one thread.

The products of the package are small, and its own threads use the processors: with threads of BLAS beside
them a run takes several times as long, and the last digits depend on their number.
"""

import ctypes
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache

_NAMES = [(f"{p}openblas_%s_num_threads{s}", "get", "set") for p in ("scipy_", "") for s in ("64_", "")]
_NAMES += [("MKL_%s_Threads", "Get_Max", "Set_Num")]
_lock, _before = threading.Lock(), list[int]()
_blocks = 0


@cache
def _libraries() -> list[tuple[Callable[[], int], Callable[[int], object]]]:
    """Functions that get and set the number of threads of the BLAS of NumPy and of SciPy, if it has them."""
    # Imported on use: other modules of SciPy come with it.
    import numpy.linalg._umath_linalg
    import scipy.linalg.cython_blas

    found = []
    for module in (numpy.linalg._umath_linalg, scipy.linalg.cython_blas):
        # A symbol is also looked up in the libraries that an extension module is linked to.
        library = ctypes.CDLL(module.__file__)
        pairs = [(name % first, name % second) for name, first, second in _NAMES]
        found += [(getattr(library, g), getattr(library, s)) for g, s in pairs if hasattr(library, s)]
    return found


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let BLAS use one thread in a block, or in each call of a function that this decorates."""
    global _blocks
    with _lock:
        _blocks += 1
        if _blocks == 1:
            _before[:] = [get() for get, _ in _libraries()]
            for _, put in _libraries():
                put(1)
    try:
        yield
    finally:
        with _lock:
            _blocks -= 1
            if _blocks == 0:
                for (_, put), threads in zip(_libraries(), _before, strict=True):
                    put(threads)
