"""Compiled functions (kernels), the threads that run them, and digests of code.

numba's own disk cache looks at one file only: after an edit of a called function the old code would run. Here
the key is a digest of all code and constants that a kernel refers to, as for the results of stages.
"""

# numba's own modules have no types.
# mypy: disable-error-code="no-untyped-call"

import contextlib
import dis
import functools
import gc
import hashlib
import importlib.util
import io
import logging
import os
import pickle
import stat
import sys
import sysconfig
import tempfile
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, MappingProxyType, ModuleType
from typing import Any, ParamSpec, TypeVar, overload

import numba
import numpy as np
from numba import types
from numba.core.compiler import CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.serialize import dumps
from numpy.typing import NDArray

P = ParamSpec("P")
T = TypeVar("T")
Function = TypeVar("Function", bound=Callable[..., Any])

_log = logging.getLogger(__name__)

CACHE_VARIABLE = "NUMBA_CACHE_DIR"  # Environment variable: the folder of the compiled kernels

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

    It releases the global interpreter lock, and divides by zero as NumPy does. ``options`` are those of
    `numba.njit`, such as ``fastmath``; with options only, a decorator is returned.
    """
    if function is None:
        return lambda function: kernel(function, **options)
    if vars(numba.config)["DISABLE_JIT"]:
        return function
    return Kernel(function, targetoptions=OPTIONS | options)


class Kernel(CPUDispatcher):
    """A function that numba compiles, or loads from the disk, for the types of its arguments."""

    _cache: Any

    def __call__(self, *args: Any) -> Any:
        try:
            return super().__call__(*args)
        except SystemError as error:
            # A signal that arrives in machine code raises when numba makes the result, which does not look.
            first: BaseException = error
            while first.__cause__ is not None:
                first = first.__cause__
            raise first from None

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
    again = f"each process compiles them again; set the variable {CACHE_VARIABLE} to a writable folder"
    _log.warning("compiled kernels cannot be kept in %s (%s): %s", folder, reason, again)


def cache_folder() -> Path:
    """Folder of the compiled kernels: NUMBA_CACHE_DIR, or the first of some that can be written to."""
    if os.environ.get(CACHE_VARIABLE):
        return Path(os.environ[CACHE_VARIABLE]) / "thesisrecon"
    beside = PACKAGE / "__pycache__" / "kernels"
    places = [beside]
    # Path.home fails in a container whose user has neither HOME nor an entry of a name.
    with contextlib.suppress(RuntimeError):
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        places.append(home / "thesisrecon" / "kernels")
    for place in places:
        with contextlib.suppress(OSError):
            place.mkdir(parents=True, exist_ok=True)
            if os.access(place, os.W_OK):
                return place
    with contextlib.suppress(OSError, AttributeError):  # Windows has no user numbers
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


class ThreadPool(ThreadPoolExecutor):
    """A pool of threads. If none can be started (limit of a container or user), the calling thread works."""

    def __init__(self, threads: int) -> None:
        super().__init__(max(threads, 1))
        self.alone = False
        try:
            super().submit(int)
        except RuntimeError:
            self.alone = True

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Give a task to a thread, or process it."""
        if not self.alone:
            return super().submit(fn, *args, **kwargs)
        done = Future[T]()
        try:
            done.set_result(fn(*args, **kwargs))
        except Exception as error:
            done.set_exception(error)
        return done

    def _adjust_thread_count(self) -> None:
        try:
            super()._adjust_thread_count()
        except RuntimeError:
            # Those that could be started process all tasks.
            if not self._threads:
                raise


_IMPORT = dis.opmap["IMPORT_NAME"]
_LIBRARIES = [Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "purelib", "platlib")]

# Only the names of these libraries are hashed, even if the value itself belongs to one.
_BY_NAME = {*sys.stdlib_module_names, "numpy", "scipy", "numba"}
# Python and its libraries note other things in classes, some of them when an instance is pickled.
_NOTED = ("_abc_impl", "_is_protocol", "_is_runtime_protocol", "__dict__", "__weakref__")


def code_digest(*values: Any) -> str:
    """SHA-256 digest of functions, classes or objects and of all code that they refer to, not of comments.

    Of an installed library only the name is hashed, unless a value belongs to it. An object that cannot be
    pickled gives a new digest each time, so that stored results are never used for it.
    """
    walk = _Walk({"thesisrecon", *(_package_of(value) for value in values)} - _BY_NAME)
    walk.add(values)
    # Those that are found on the way are appended.
    for value in walk.reached:
        if walk.follows(value.__module__):
            walk.add(_parts_of_class(value) if isinstance(value, type) else walk.parts_of(value))
    return walk.digest.hexdigest()


def _package_of(value: Any) -> str:
    module = getattr(value, "__module__", None) or type(value).__module__
    return str(module).partition(".")[0]


@cache
def _is_library(package: str) -> bool:
    if package in sys.builtin_module_names or package == "builtins":
        return True
    module = sys.modules.get(package)
    # A library that is imported on use may not be loaded.
    found = importlib.util.find_spec(package) if module is None else None
    file = getattr(module, "__file__", None) or getattr(found, "origin", None)
    # Functions defined at a prompt belong to __main__, whose file may be that of an installed command.
    if package == "__main__" or not file:
        return False
    place = Path(file).resolve()
    # An environment may see the packages of another, as of the system.
    return bool({"site-packages", "dist-packages"} & set(place.parts)) or any(
        place.is_relative_to(folder) for folder in _LIBRARIES
    )


class _Walk:
    """Hashes values; functions and classes by their names, what they consist of afterwards and once."""

    def __init__(self, packages: set[str]) -> None:
        self._packages, self._seen = packages, set[int]()
        self.reached: list[Any] = []  # functions and classes
        self.digest = hashlib.sha256()

    def follows(self, module: str) -> bool:
        """Whether the code of a module counts, not only its name."""
        package = str(module).partition(".")[0]
        return package in self._packages or not _is_library(package)

    def add(self, value: Any) -> None:
        """Hash a value."""
        stream = io.BytesIO()
        pickler = _Pickler(stream, self)
        # Equal values give equal bytes, whether they are one object or several.
        pickler.fast = True
        try:
            pickler.dump(value)
        except Exception:
            # Any class may raise anything here.
            stream.write(uuid.uuid4().bytes)
        self.digest.update(stream.getvalue())

    def name_of(self, value: Any) -> str:
        """The name of a function or class, which is reached with it."""
        if id(value) not in self._seen:
            self._seen.add(id(value))
            self.reached.append(value)
        return f"{value.__module__}.{value.__qualname__}"

    def parts_of(self, function: FunctionType) -> list[Any]:
        """Defaults, closure, byte code, constants and the values of global names, also of modules."""
        parts: list[Any] = [function.__defaults__, function.__kwdefaults__]
        for cell in function.__closure__ or ():
            with contextlib.suppress(ValueError):  # not yet filled
                parts.append(cell.cell_contents)
        codes = [function.__code__]
        for code in codes:
            names, plain = code.co_names, [c for c in code.co_consts if c != function.__doc__]
            codes += [constant for constant in plain if isinstance(constant, CodeType)]
            parts += [code.co_code, names, code.co_varnames, code.co_freevars, code.co_exceptiontable]
            parts.append([constant for constant in plain if not isinstance(constant, CodeType)])
            values = [function.__globals__[name] for name in names if name in function.__globals__]
            modules = [value for value in values if isinstance(value, ModuleType)]
            operations, arguments = code.co_code[::2], code.co_code[1::2]
            # Few functions import.
            places = [k for k, o in enumerate(operations) if o == _IMPORT] if _IMPORT in operations else []
            for name in (names[arguments[k]] for k in places if arguments[k] < len(names)):
                with contextlib.suppress(ImportError):
                    # `from . import name` has no module name.
                    modules += [importlib.import_module(name)] if name and self.follows(name) else []
            for module in modules:
                used = [getattr(module, name, None) for name in names if self.follows(module.__name__)]
                modules += [one for one in used if isinstance(one, ModuleType) and one not in modules]
                values += used
            parts.append(values)
        return parts


def _parts_of_class(kind: type) -> list[Any]:
    """Annotations, bases and members of a class."""
    members = [
        (name, member)
        for name, member in list(vars(kind).items())
        if name not in _NOTED and not name.startswith("__annot")
        if not name.startswith("__") or hasattr(member, "__get__")
    ]
    return [str(vars(kind).get("__annotations__", "")), kind.__bases__, members]


class _Pickler(pickle.Pickler):
    """Writes by what it consists of what pickle refuses, or writes in another way in each process."""

    def __init__(self, stream: io.BytesIO, walk: _Walk) -> None:
        super().__init__(stream, 5)
        self._walk = walk

    def persistent_id(self, value: Any) -> Any:
        if isinstance(value, FunctionType | type):
            return self._walk.name_of(value)
        if isinstance(value, ModuleType | ContextVar):
            return getattr(value, "__name__", None) or value.name
        if isinstance(value, set | frozenset):
            return sorted(value, key=repr)
        if type(value) is MappingProxyType:
            return dict(value)
        # A kernel; other objects may answer to any name.
        if hasattr(value, "targetoptions") and isinstance(getattr(value, "py_func", None), FunctionType):
            return sorted(value.targetoptions.items()), value.py_func
        if isinstance(value, property):
            return value.fget, value.fset
        if isinstance(value, functools.cached_property):
            return (value.func,)
        if "__wrapped__" in getattr(value, "__dict__", ()) or isinstance(value, staticmethod | classmethod):
            return (value.__wrapped__,)
        return None
