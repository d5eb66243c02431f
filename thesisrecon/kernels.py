"""Compiled functions (kernels): numba with a disk cache that is keyed by all code a kernel is made from.

numba's own cache looks at one file only: after an edit of a function that a kernel of another module calls,
the old machine code would run. Here the key is a digest of the kernel's code, its constants and options, and
the same of everything that it refers to.
"""

# numba's own modules have no types.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import contextlib
import fcntl
import gc
import hashlib
import logging
import operator
import os
import pickle
import stat
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypeVar, overload

import numba
import numpy as np
from numba.core import cgutils, codegen, types
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps
from numba.core.sigutils import normalize_signature
from numba.core.typing.arraydecl import GetItemBuffer, SetItemBuffer
from numba.core.typing.templates import AbstractTemplate, infer, infer_global, signature
from numba.cpython.builtins import do_minmax
from numba.extending import lower_builtin, type_callable
from numba.np.arrayobj import _empty_nd_impl

from thesisrecon._code_digest import code_digest

Function = TypeVar("Function", bound=Callable[..., Any])

_log = logging.getLogger(__name__)

CACHE_VARIABLE = "NUMBA_CACHE_DIR"
"""Environment variable: the folder of the compiled kernels."""

MAX_WAIT_S = 60.0
"""Longest wait for another process that compiles the same kernel."""

COMPILER_SETTINGS = ("OPT", "BOUNDSCHECK", "DEBUGINFO_DEFAULT", "LOOP_VECTORIZE", "SLP_VECTORIZE")
"""Settings of numba that change the machine code."""

FAST = {"contract", "reassoc", "nsz", "arcp"}
"""Fast mathematics of kernels: sums may be reordered. To assume no NaN would remove checks of bounds."""

PACKAGE = Path(__file__).parent
LIST = PACKAGE / "kernels.txt"
"""Kernels that a run calls from Python, with the types of their arguments; see `runtime._precompilation`."""

_pickled: Callable[[Any], bytes] = dumps


def _set_up_compiler() -> None:
    """Compile at level 2, a third faster than numba's default of 3, and make vectors of equal statements.

    The variables NUMBA_OPT and NUMBA_SLP_VECTORIZE override this. Numba's compiler resets its settings once
    any variable NUMBA_* has changed: that is done first.
    """
    numba.config.reload_config()
    settings = vars(numba.config)
    if "NUMBA_OPT" not in os.environ:
        settings["OPT"] = type(settings["OPT"])(2)
    if "NUMBA_SLP_VECTORIZE" not in os.environ:
        settings["SLP_VECTORIZE"] = 1


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

    def compiled(function: Callable[..., Any]) -> Any:
        settings: dict[str, Any] = {
            "error_model": "numpy",
            "nogil": True,
            "no_cfunc_wrapper": True,
            **options,
        }
        dispatcher: Any = numba.njit(**settings)(function)
        if isinstance(dispatcher, Dispatcher):  # a plain function where NUMBA_DISABLE_JIT is set
            stored = KernelCache(dispatcher)
            vars(dispatcher).update(
                _cache=stored,
                compile=stored.releasing(dispatcher.compile),
                add_overload=stored.registering(dispatcher.add_overload),
                get_call_template=_for_a_kernel(dispatcher.get_call_template),
            )
            compiler: Any = vars(dispatcher)["_compiler"]
            compiler._customize_flags = stored.with_or_without_wrapper
        return dispatcher

    return compiled if function is None else compiled(function)


# numba times each call of LLVM for its statistics, which takes longer than most of these calls.
with contextlib.suppress(AttributeError, KeyError):
    vars(codegen)["ll"].ffi.lib._lock._cblist.clear()

_caller = threading.local()
"""`is_kernel` is set while this thread compiles a kernel for another one."""


def _for_a_kernel(template: Callable[..., Any]) -> Callable[..., Any]:
    """Let kernels call kernels with plain types; numba would compile a version for each literal argument."""

    def get_call_template(args: Any, kws: Any) -> Any:
        plain = tuple(types.unliteral(a) for a in args)
        before, _caller.is_kernel = getattr(_caller, "is_kernel", False), True
        try:
            return template(plain, {name: types.unliteral(a) for name, a in kws.items()})
        finally:
            _caller.is_kernel = before

    return get_call_template


@cache
def _called_by_python() -> set[str]:
    """Names of the kernels that a run calls from Python."""
    return {line.partition("(")[0] for line in LIST.read_text(encoding="utf-8").splitlines()}


@contextlib.contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """Pause Python's garbage collection: it would search all of numba's objects several times a second."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


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


class KernelCache(NullCache):
    """Cache of the compiled signatures of one kernel, one file each, written whole or not at all.

    A process that misses an entry holds a lock while it compiles, so that others wait for the result instead
    of compiling the same. A lock ends with its process.

    Parameters
    ----------
    dispatcher : numba dispatcher
    """

    def __init__(self, dispatcher: Dispatcher) -> None:
        self._dispatcher = dispatcher
        function = dispatcher.py_func
        self._name = f"{function.__module__.removeprefix('thesisrecon.')}.{function.__name__}"
        self._digest = ""
        self._locks: dict[Path, IO[bytes]] = {}
        self._only_for_kernels: set[tuple[Any, ...]] = set()

    @property
    def cache_path(self) -> str:
        return str(cache_folder())

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:
        rtsys.initialize(target_context)  # machine code that is loaded calls numba's runtime
        path = self._path(sig, target_context.codegen())
        found = _read(path, target_context)
        if found is None and path not in self._locks:
            self._lock(path)
            found = _read(path, target_context)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        path = self._path(sig, data.codegen)
        # With a full disk or a read-only folder the kernel still runs, without a cache.
        try:
            _write(path, _pickled(data._reduce()))
        except OSError as error:
            _warn_once(path.parent, error.strerror or type(error).__name__)

    def _path(self, sig: Any, codegen: Any) -> Path:
        self._digest = self._digest or code_digest(self._dispatcher)
        what = (
            self._digest,
            str(sig),
            codegen.magic_tuple(),
            sys.implementation.cache_tag,
            (numba.__version__, np.__version__),
            [getattr(numba.config, name) for name in COMPILER_SETTINGS],
            self.is_for_kernels(),
        )
        key = hashlib.sha256(repr(what).encode()).hexdigest()[:32]
        return cache_folder() / f"{self._name}-{key}"

    def is_for_kernels(self) -> bool:
        """Whether the current compilation needs no wrapper for Python, which takes a tenth of the time."""
        return getattr(_caller, "is_kernel", False) and self._name not in _called_by_python()

    def with_or_without_wrapper(self, flags: Any) -> Any:
        """Change numba's flags of a compilation."""
        flags.no_cpython_wrapper = self.is_for_kernels()
        return flags

    def releasing(self, compile_signature: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """Release the lock of a compilation even if it fails; loading and saving happen inside it."""

        def compile_and_release(signature: Any) -> Any:
            before = set(self._locks)
            _set_up_compiler()
            try:
                with global_compiler_lock, _without_garbage_collection():
                    arguments = tuple(normalize_signature(signature)[0])
                    if arguments in self._only_for_kernels and not self.is_for_kernels():
                        self._only_for_kernels.remove(arguments)
                        del self._dispatcher.overloads[arguments]
                    return compile_signature(signature)
            finally:
                for path in set(self._locks) - before:
                    self._unlock(path)

        return compile_and_release

    def registering(self, add_overload: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """Hide from Python the code that is compiled only for other kernels."""

        def add(compiled: Any) -> None:
            arguments = tuple(compiled.signature.args)
            if self.is_for_kernels():
                self._only_for_kernels.add(arguments)
                self._dispatcher.overloads[arguments] = compiled
            else:
                add_overload(compiled)

        return add

    def _lock(self, path: Path) -> None:
        """Lock an entry; wait at most MAX_WAIT_S for another process that compiles it."""
        # On a file system without locks two processes may compile the same kernel, which is harmless.
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            file = path.with_name(path.name + ".lock").open("wb")
            end = time.monotonic() + MAX_WAIT_S
            while True:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    self._locks[path] = file
                    return
                except BlockingIOError:
                    if path.exists() or time.monotonic() > end:
                        file.close()
                        return
                    time.sleep(0.02)

    def _unlock(self, path: Path) -> None:
        file = self._locks.pop(path, None)
        if file is not None:
            with contextlib.suppress(OSError):
                path.with_name(path.name + ".lock").unlink(missing_ok=True)
                # A forked process may hold the same open file.
                fcntl.flock(file, fcntl.LOCK_UN)
            file.close()


@cache
def _warn_once(folder: Path, reason: str) -> None:
    _log.warning(
        "compiled kernels cannot be kept in %s (%s): each process compiles them again; "
        "set the variable %s to a writable folder",
        folder,
        reason,
        CACHE_VARIABLE,
    )


def _read(path: Path, target_context: Any) -> CompileResult | None:
    """The stored result; None if there is none or it is damaged."""
    try:
        stored = path.read_bytes()
    except OSError:
        return None
    digest, content = stored[:32], stored[32:]
    if hashlib.sha256(content).digest() != digest:
        return None
    try:
        payload = pickle.loads(content)
    except (ImportError, AttributeError):  # a record of the kernel has moved to another module
        return None
    rebuild: Callable[..., CompileResult] = CompileResult._rebuild
    return rebuild(target_context, *payload)


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".", delete=False) as file:
        file.write(hashlib.sha256(content).digest() + content)
    Path(file.name).replace(path)


if TYPE_CHECKING:
    from numpy import empty as empty
    from numpy import full as full
    from numpy import zeros as zeros
else:
    # numba compiles NumPy's own functions again in each kernel and for each shape, with their messages.
    def empty(shape, dtype=np.float64):
        """`numpy.empty` for kernels."""
        return np.empty(shape, dtype)

    def full(shape, value, dtype=np.float64):
        """`numpy.full` for kernels."""
        return np.full(shape, value, dtype)

    def zeros(shape, dtype=np.float64):
        """`numpy.zeros` for kernels."""
        return np.zeros(shape, dtype)


def _array_type(shape: Any, dtype: Any = types.float64) -> Any:
    scalar = getattr(dtype, "instance_type", dtype)
    return types.Array(scalar, len(shape) if isinstance(shape, types.BaseTuple) else 1, "C")


@type_callable(empty)
@type_callable(zeros)
def _type_empty(_: Any) -> Any:
    return lambda shape, dtype=types.float64: _array_type(shape, dtype)


@type_callable(full)
def _type_full(_: Any) -> Any:
    return lambda shape, value, dtype=types.float64: _array_type(shape, dtype)  # noqa: ARG005 - the names count


@lower_builtin(empty, types.VarArg(types.Any))
def _lower_empty(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return _allocate(context, builder, signature, arguments)._getvalue()


@lower_builtin(zeros, types.VarArg(types.Any))
def _lower_zeros(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    array = _allocate(context, builder, signature, arguments)
    size = builder.mul(array.itemsize, array.nitems)
    cgutils.memset(builder, array.data, size, 0)
    return array._getvalue()


@lower_builtin(full, types.VarArg(types.Any))
def _lower_full(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    array = _allocate(context, builder, signature, arguments)
    value = context.cast(builder, arguments[1], signature.args[1], signature.return_type.dtype)
    with cgutils.for_range(builder, array.nitems) as loop:
        place = builder.gep(array.data, [loop.index])
        context.pack_value(builder, signature.return_type.dtype, value, place)
    return array._getvalue()


def _allocate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    given: Any = arguments[0]
    kind: Any = signature.args[0]
    is_tuple = isinstance(kind, types.BaseTuple)
    parts = cgutils.unpack_tuple(builder, given) if is_tuple else [given]
    kinds = list(kind) if is_tuple else [kind]
    shape = [context.cast(builder, part, of, types.intp) for part, of in zip(parts, kinds, strict=True)]
    return _empty_nd_impl(context, builder, signature.return_type, shape)


class _NumberTemplate(AbstractTemplate):
    """Types of `max` and `min` of numbers and of `int` in kernels.

    numba's own versions are Python code, which it compiles again for each kernel and each literal argument.
    """

    key: Any

    def generic(self, args: Any, kws: Any) -> Any:
        if kws or not args or not all(isinstance(a, (types.Integer, types.Float)) for a in args):
            return None
        plain = [types.unliteral(a) for a in args]
        if self.key is not int:
            return signature(self.context.unify_types(*plain), *plain) if len(plain) > 1 else None
        return signature(plain[0] if isinstance(plain[0], types.Integer) else types.intp, *plain)


class _ArithmeticTemplate(AbstractTemplate):
    """Types of sums, differences and products, whose search took numba a tenth of the compile time."""

    key: Any

    def generic(self, args: Any, kws: Any) -> Any:  # noqa: ARG002 - the names count
        kinds = [types.unliteral(a) for a in args]
        if len(kinds) != 2 or any(kind not in {types.int64, types.float64} for kind in kinds):
            return None
        kind = types.float64 if types.float64 in kinds else types.int64
        return signature(kind, kind, kind)


def _prefer(template: Any, function: Any) -> None:
    """Let numba try a template of a function first, as one of a target."""
    named = type(
        f"_{function.__name__.title()}", (template,), {"key": function, "metadata": {"target": "cpu"}}
    )
    infer_global(function, types.Function(infer(named)))


def _register(function: Any, lower: Any) -> None:
    _prefer(_NumberTemplate, function)
    lower_builtin(function, types.VarArg(types.Number))(lower)


def _lower_int(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return context.cast(builder, arguments[0], signature.args[0], signature.return_type)


def _lower_choice(compare: Any) -> Any:
    def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return do_minmax(context, builder, list(signature.args), arguments, compare)

    return lower


_register(int, _lower_int)
_register(max, _lower_choice(operator.gt))
_register(min, _lower_choice(operator.lt))
_prefer(GetItemBuffer, operator.getitem)
_prefer(SetItemBuffer, operator.setitem)
for _operator in (operator.add, operator.sub, operator.mul):
    _prefer(_ArithmeticTemplate, _operator)


@kernel
def copy_to(out: Any, values: Any) -> None:
    """Copy a vector inside kernels: ``out[:] = values`` without a check of the shapes and its message."""
    for k in range(len(out)):
        out[k] = values[k]
