"""Digest of functions and classes with the code that they use: the key of stored kernels and results."""

from __future__ import annotations

import contextlib
import dataclasses
import dis
import functools
import hashlib
import importlib.util
import io
import pickle
import sys
import sysconfig
import uuid
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, MappingProxyType, MethodType, ModuleType
from typing import Any

import numpy as np

OWN = __name__.partition(".")[0]
_IMPORT = dis.opmap["IMPORT_NAME"]
_LIBRARIES = [Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "purelib", "platlib")]

# Only the names of these libraries are hashed, even if the value itself belongs to one.
_BY_NAME = {*sys.stdlib_module_names, "numpy", "scipy", "numba"}
_PLAIN = {int, float, str, bytes, bool, type(None)}
_NOTED = {"_abc_impl", "_is_protocol", "_is_runtime_protocol"}


def code_digest(*values: Any) -> str:
    """SHA-256 digest of functions, classes or objects and of all code that they refer to.

    Constants, defaults, closures, base classes, methods, fields and imports inside functions are followed.
    Of an installed library only the name is hashed, unless a value belongs to it. Comments, docstrings and
    line numbers have no effect. Objects are hashed by their pickled state; an object that cannot be pickled
    (of a C++ library, for example) gives a new digest each time, so stored results are never used for it.
    """
    walk = _Walk({OWN, *(_package_of(value) for value in values)} - _BY_NAME)
    walk.follow(values)
    return hashlib.sha256("".join(f"{text}\0" for text in walk.found).encode()).hexdigest()


def _package_of(value: Any) -> str:
    module = getattr(value, "__module__", None) or type(value).__module__
    return str(module).partition(".")[0]


@cache
def _is_library(package: str) -> bool:
    module = sys.modules.get(package)
    # A library that is imported on use may not be loaded.
    found = importlib.util.find_spec(package) if module is None else None
    file = getattr(module, "__file__", None) or getattr(found, "origin", None)
    if package in sys.builtin_module_names or package == "builtins":
        return True
    place = Path(file).resolve() if file else None
    # Functions defined at a prompt belong to __main__, whose file may be that of an installed command.
    return (
        package != "__main__"
        and place is not None
        and any(place.is_relative_to(folder) for folder in _LIBRARIES)
    )


class _Pickler(pickle.Pickler):
    """Collects the functions and classes that an object refers to; pickle notes their names only."""

    def __init__(self, stream: io.BytesIO) -> None:
        super().__init__(stream, 5)
        self.code: list[Any] = []

    def persistent_id(self, value: Any) -> str | None:
        if isinstance(value, (FunctionType, type, ModuleType)) or hasattr(value, "py_func"):
            self.code.append(value)
            return str(value.__name__)
        return None


class _Walk:
    """Collects as text everything that the behaviour of a value depends on."""

    def __init__(self, packages: set[str]) -> None:
        self._packages = packages
        self._seen: dict[int, Any] = {}  # keeps the objects, so that no identity is used twice
        self.found: list[str] = []

    def _followed(self, module: str) -> bool:
        package = str(module).partition(".")[0]
        return package in self._packages or not _is_library(package)

    def follow(self, value: Any) -> None:
        """Add everything that the behaviour of a value depends on."""
        if type(value) in _PLAIN:
            self.found.append(repr(value))
            return
        # A kernel; other objects may answer to any name.
        if hasattr(value, "targetoptions") and isinstance(getattr(value, "py_func", None), FunctionType):
            self.follow(sorted(value.targetoptions.items()))
            value = value.py_func
        if isinstance(value, (staticmethod, classmethod, MethodType)):
            value = value.__func__
        if isinstance(value, FunctionType):
            self._function(value)
        elif isinstance(value, type):
            self._class(value)
        elif isinstance(value, property):
            self.follow((value.fget, value.fset))
        elif isinstance(value, functools.cached_property):
            self.follow(value.func)
        elif isinstance(value, functools.partial):
            self.follow((value.func, value.args, value.keywords))
        elif hasattr(value, "__wrapped__"):
            self.follow(value.__wrapped__)
        else:
            self._plain(value)

    def _plain(self, value: Any) -> None:
        library = not self._followed(type(value).__module__)
        if type(value) in (list, set, frozenset) or isinstance(value, tuple):
            self.found.append(f"{type(value).__name__} {len(value)}")
            # The order of a set changes from process to process.
            for item in sorted(value, key=repr) if isinstance(value, (set, frozenset)) else value:
                self.follow(item)
        elif type(value) is MappingProxyType or (isinstance(value, dict) and library):
            self.found.append(f"mapping {len(value)}")
            for key, item in value.items():
                self.follow((key, item))
        elif isinstance(value, np.ndarray):
            self.found.append(f"{value.dtype} {value.shape} {value.tobytes().hex()}")
        elif isinstance(value, ModuleType):
            self.found.append(value.__name__)
        elif isinstance(value, (int, float, complex, str, bytes, np.generic, np.dtype, Path, type(None))):
            self.found.append(repr(value))
        else:
            self._class(type(value))
            if id(value) in self._seen:
                return
            self._seen[id(value)] = value
            if dataclasses.is_dataclass(value):
                for field in dataclasses.fields(value):
                    self.follow((field.name, getattr(value, field.name, None)))
            elif library and isinstance(name := getattr(value, "__qualname__", None), str):
                owner = getattr(value, "__self__", None)
                self.found.append(name)
                self.follow(None if isinstance(owner, type) else owner)
            else:
                self._state(value)

    def _state(self, value: Any) -> None:
        """The pickled state of an object, and the functions and classes in it."""
        stream = io.BytesIO()
        pickler = _Pickler(stream)
        try:
            pickler.dump(value)
            self.found.append(hashlib.sha256(stream.getvalue()).hexdigest())
        except Exception:
            # Any class may raise anything here.
            self.found.append(uuid.uuid4().hex)
        self.follow(pickler.code)

    def _function(self, function: FunctionType) -> None:
        self.found.append(f"{function.__module__}.{function.__qualname__}")
        if id(function) in self._seen or not self._followed(function.__module__):
            return
        self._seen[id(function)] = function
        self.follow((function.__defaults__, function.__kwdefaults__))
        for cell in function.__closure__ or ():
            try:
                self.follow(cell.cell_contents)
            except ValueError:  # not yet filled
                self.found.append("empty")
        self._code(function.__code__, function)

    def _class(self, kind: type) -> None:
        self.found.append(f"{kind.__module__}.{kind.__qualname__}")
        if id(kind) in self._seen or not self._followed(kind.__module__):
            return
        self._seen[id(kind)] = kind
        self.found.append(str(vars(kind).get("__annotations__", "")))
        self.follow(kind.__bases__)
        for name, member in list(vars(kind).items()):
            # Python and its libraries note other things there, some of them when an instance is pickled.
            noted = name.startswith("__") and not hasattr(member, "__get__")
            if not noted and name not in _NOTED:
                self.found.append(name)
                self.follow(member)

    def _code(self, code: CodeType, function: FunctionType) -> None:
        self.found.append(code.co_code.hex())
        names = f"{code.co_names} {code.co_varnames} {code.co_freevars}"
        self.found.append(f"{names} {code.co_exceptiontable.hex()}")
        for constant in code.co_consts:
            if isinstance(constant, CodeType):
                self._code(constant, function)
            elif constant != function.__doc__:
                self.follow(constant)
        modules = []
        for name in code.co_names:
            if name in function.__globals__:
                value = function.__globals__[name]
                modules += [value] if isinstance(value, ModuleType) else []
                self.found.append(name)
                self.follow(value)
        operations = code.co_code[::2]
        # Few functions import.
        imports = zip(operations, code.co_code[1::2], strict=True) if _IMPORT in operations else ()
        for operation, argument in imports:
            if operation == _IMPORT and argument < len(code.co_names):
                name = code.co_names[argument]
                with contextlib.suppress(ImportError):
                    # `from . import name` has no module name.
                    modules += [importlib.import_module(name)] if name and self._followed(name) else []
        for module in modules:
            if self._followed(module.__name__):
                for name in code.co_names:
                    value = getattr(module, name, None)
                    if isinstance(value, ModuleType) and value not in modules:
                        modules.append(value)
                    self.follow(value)
