"""Compiled functions (kernels): numba with a disk cache that is keyed by all code a kernel is made from.

numba's own cache looks at one file only: after an edit of a function that a kernel of another module calls,
the old machine code would run. Here the key is a digest of the kernel's code, its constants and options, and
the same of everything that it refers to.
"""

# numba's own modules have no types.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import contextlib
import gc
import hashlib
import logging
import os
import pickle
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, overload

import numba
import numpy as np
from numba import types
from numba.core.compiler import CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.serialize import dumps
from numpy.typing import NDArray

from thesisrecon._code_digest import code_digest

Function = TypeVar("Function", bound=Callable[..., Any])

_log = logging.getLogger(__name__)

CACHE_VARIABLE = "NUMBA_CACHE_DIR"
"""Environment variable: the folder of the compiled kernels."""

OPTIONS = {"nopython": True, "error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True}

COMPILER_SETTINGS = {"OPT": 2, "SLP_VECTORIZE": 1}
"""Level 2 compiles a third faster than numba's 3. NUMBA_OPT and NUMBA_SLP_VECTORIZE override it."""

FAST = {"contract", "reassoc", "nsz", "arcp"}
"""Fast mathematics of kernels: sums may be reordered. To assume no NaN would remove checks of bounds."""

PACKAGE = Path(__file__).parent


@overload
def kernel(function: Function) -> Function: ...


@overload
def kernel(**options: Any) -> Callable[[Function], Function]: ...


def kernel(function: Any = None, **options: Any) -> Any:
    """Compile a function with numba on its first call and keep the machine code on disk.

    Parameters
    ----------
    function : callable, optional
        The function; without it, a decorator.
    **options
        Options of `numba.njit`, such as ``fastmath``.

    Returns
    -------
    numba dispatcher or decorator
        The compiled function. It releases the global interpreter lock, and divides by zero as NumPy does.
    """
    if function is None:
        return lambda function: kernel(function, **options)
    if vars(numba.config)["DISABLE_JIT"]:
        return function
    return Kernel(function, targetoptions=OPTIONS | options)


class Kernel(CPUDispatcher):
    """A function that numba compiles, or loads from the disk, for the types of its arguments."""

    _cache: Any

    def get_call_template(self, args: Any, kws: Any) -> Any:
        # For a kernel that calls this one; numba would compile a version for each literal argument.
        plain = {name: types.unliteral(kind) for name, kind in kws.items()}
        return super().get_call_template(tuple(types.unliteral(kind) for kind in args), plain)

    def enable_caching(self) -> None:
        pass  # always

    def compile(self, sig: Any) -> Any:
        with global_compiler_lock, _compiler_settings():
            if not isinstance(self._cache, KernelCache):
                self._cache = KernelCache(self)
            return super().compile(sig)


@contextlib.contextmanager
def _compiler_settings() -> Iterator[None]:
    """Set the level; pause Python's garbage collection, which would search numba's objects each second."""
    # numba reads all variables again when one of them has changed: not after this.
    numba.config.reload_config()
    settings, enabled = vars(numba.config), gc.isenabled()
    before = {name: settings[name] for name in COMPILER_SETTINGS if f"NUMBA_{name}" not in os.environ}
    settings.update({name: type(value)(COMPILER_SETTINGS[name]) for name, value in before.items()})
    gc.disable()
    try:
        yield
    finally:
        settings.update(before)
        if enabled:
            gc.enable()


class KernelCache:
    """Compiled versions of one kernel, a file for each, written whole or not at all."""

    def __init__(self, dispatcher: Kernel) -> None:
        self._dispatcher, function = dispatcher, dispatcher.py_func
        self._name = f"{function.__module__.removeprefix('thesisrecon.')}.{function.__name__}"
        self._digest = code_digest(dispatcher)

    @property
    def cache_path(self) -> str:
        return str(cache_folder())

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:
        target_context.refresh()  # machine code that is loaded calls numba's runtime
        # A damaged file, or a record of the kernel that has moved to another module: compile again.
        with contextlib.suppress(OSError, ImportError, AttributeError):
            stored = self._path(sig, target_context.codegen()).read_bytes()
            if hashlib.sha256(stored[32:]).digest() == stored[:32]:
                found: CompileResult = CompileResult._rebuild(target_context, *pickle.loads(stored[32:]))
                return found
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        path, content = self._path(sig, data.codegen), dumps(data._reduce())
        # With a full disk or a read-only folder the kernel still runs, without a cache.
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".", delete=False) as file:
                file.write(hashlib.sha256(content).digest() + content)
            Path(file.name).replace(path)
        except OSError as error:
            _warn_once(path.parent, error.strerror or type(error).__name__)

    def _path(self, sig: Any, codegen: Any) -> Path:
        names = (*COMPILER_SETTINGS, "BOUNDSCHECK", "DEBUGINFO_DEFAULT", "LOOP_VECTORIZE")
        settings = [getattr(numba.config, name) for name in names]
        versions = (sys.implementation.cache_tag, numba.__version__, np.__version__)
        key = repr((self._digest, str(sig), codegen.magic_tuple(), versions, settings))
        return cache_folder() / f"{self._name}-{hashlib.sha256(key.encode()).hexdigest()[:32]}"


@cache
def _warn_once(folder: Path, reason: str) -> None:
    _log.warning(
        "compiled kernels cannot be kept in %s (%s): each process compiles them again; "
        "set the variable %s to a writable folder",
        folder,
        reason,
        CACHE_VARIABLE,
    )


def cache_folder() -> Path:
    """Folder of the compiled kernels: in NUMBA_CACHE_DIR, beside the package, or in the user's cache.

    Returns
    -------
    Path
        The first folder that can be written to; else an own one for temporary files.
    """
    if os.environ.get(CACHE_VARIABLE):
        return Path(os.environ[CACHE_VARIABLE]) / "thesisrecon"
    beside = PACKAGE / "__pycache__" / "kernels"
    with contextlib.suppress(OSError):
        beside.mkdir(parents=True, exist_ok=True)
        if os.access(beside, os.W_OK):
            return beside
    # Path.home fails in a container whose user has neither HOME nor an entry of a name.
    with contextlib.suppress(OSError, RuntimeError):
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "thesisrecon" / "kernels"
        home.mkdir(parents=True, exist_ok=True)
        if os.access(home, os.W_OK):
            return home
    with contextlib.suppress(OSError):
        own = Path(tempfile.gettempdir()) / f"thesisrecon-kernels-{os.getuid()}"
        own.mkdir(mode=0o700, exist_ok=True)
        found = own.lstat()
        # Machine code of another user must not be run.
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077:
            return own
    return beside


# numba compiles NumPy's own functions again in each kernel and for each shape; these once.
@kernel
def empty(shape: Any, dtype: Any = np.float64) -> NDArray[Any]:
    """`numpy.empty` for kernels."""
    return np.empty(shape, dtype)


@kernel
def full(shape: Any, value: Any, dtype: Any = np.float64) -> NDArray[Any]:
    """`numpy.full` for kernels."""
    return np.full(shape, value, dtype)


@kernel
def zeros(shape: Any, dtype: Any = np.float64) -> NDArray[Any]:
    """`numpy.zeros` for kernels."""
    return np.zeros(shape, dtype)


@kernel
def copy_to(out: Any, values: Any) -> None:
    """Copy a vector inside kernels: ``out[:] = values`` without a check of the shapes and its message."""
    for k in range(len(out)):
        out[k] = values[k]
