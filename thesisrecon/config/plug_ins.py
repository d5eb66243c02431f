"""User-defined methods of stages: functions, objects with the required methods, and code in a file.

:class:`~thesisrecon.config.PipelineConfig` passes every method through :func:`as_method`, which wraps
functions and checks objects. ``path/to/file.py:name`` is the text form of a function or class in a file.
"""

import importlib
import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

from thesisrecon.arrays import B8, F32, F64, U8, checked
from thesisrecon.epipolar._matches import PairFrame, check_matches, noise_scale
from thesisrecon.epipolar.refinement import fundamental_covariance
from thesisrecon.errors import Notice, StageFailure, UsageError, in_words, unknown_word
from thesisrecon.geometry.two_view import enforce_rank_two, sampson_residuals
from thesisrecon.records import Features, FundamentalFit, Image, Matches

# ruff: noqa: ARG002 (all methods of a stage have the same arguments)

MIN_INLIERS = 8
NOT_IN_A_FILE = " (defined in a running program, not in a file)"
"""Added to the name of a function in text; no such function can be loaded again."""
Shape = tuple[int | str, ...]


def name_of(value: Any) -> str:
    """The name of a function or class, or of the class of an object."""
    if isinstance(value, FunctionAdapter):
        value = value.function
    return str(getattr(value, "__name__", None) or type(value).__name__)


def _wrong(stage: str, who: str, what: str) -> UsageError:
    return UsageError(f"{who} returned {what}; it must return {FUNCTIONS[stage][2]}")


def _arrays(who: str, **returned: tuple[Any, Shape]) -> list[F64]:
    """The arrays that ``who`` returned, finite and of these shapes; empty lists are arrays without rows."""
    for name, (value, shape) in returned.items():
        if isinstance(value, list | tuple | np.ndarray) and not np.size(value):
            returned[name] = np.zeros((0, *map(int, shape[1:]))), shape
    try:
        return checked(f"a run, of what {who} returned,", missing=(), **returned)
    except ValueError as error:
        raise UsageError(str(error)) from None


def _require_inside(who: str, xy: F64, size: tuple[int, int] | None, name: str) -> None:
    """Raise ``UsageError`` for positions (N, 2) outside an image of a known size."""
    outside = ((xy < -0.5) | (xy > np.subtract(size or (np.inf, np.inf), 0.5))).any(axis=1)
    if size is not None and outside.any():
        x, y = xy[outside][0]
        raise UsageError(Notice("returned-outside", who, name, x, y, *size))


def _matches(
    who: str, found: Any, pair: tuple[int, int], sizes: Sequence[tuple[int, int] | None] = (None, None)
) -> Matches:
    """Matches without corners from ``xy1, xy2[, score]``."""
    if not isinstance(found, tuple | list) or len(found) not in (2, 3):
        raise _wrong("matching", who, f"a {type(found).__name__}")
    shapes: dict[str, Shape] = {"xy1": ("N", 2), "xy2": ("N", 2), "score": ("N",)}
    given = zip(shapes.items(), found, strict=False)
    xy1, xy2, *score = _arrays(who, **{name: (value, shape) for (name, shape), value in given})
    for xy, size, name in zip((xy1, xy2), sizes, shapes, strict=False):
        _require_inside(who, xy, size, name)
    none, affine = np.full(len(xy1), -1, np.int64), np.tile(np.eye(2), (len(xy1), 1, 1))
    scores: F32 = (score[0] if score else np.ones(len(xy1))).astype(np.float32)
    return Matches(*pair, none, none, xy1, xy2, scores, affine)


def matches_of(matching: Any, found: Any, pair: tuple[int, int], views: Sequence[Any]) -> Matches:
    """Check the matches that a user-defined matcher returned: the kernels that use them check nothing."""
    who = f"the method match of {type(matching).__name__}"
    if not isinstance(found, Matches):
        return _matches(who, found, pair)
    shapes: dict[str, Shape] = {"xy1": ("N", 2), "xy2": ("N", 2), "score": ("N",), "affine": ("N", 2, 2)}
    xy1, xy2, _, _ = _arrays(who, **{name: (getattr(found, name), shape) for name, shape in shapes.items()})
    index = [np.asarray(found.index1), np.asarray(found.index2)]
    for number, view in zip(index, views, strict=True):
        features = getattr(view, "features", None)
        most = np.inf if features is None else len(features.xy)
        shaped = number.shape == (len(xy1),) and number.dtype.kind == "i"
        if not shaped or ((number < -1) | (number >= most)).any():
            raise _wrong("matching", who, "indices that are not corners of the view (-1: none)")
    index1, index2 = (number.astype(np.int64) for number in index)
    return replace(found, xy1=xy1, xy2=xy2, index1=index1, index2=index2)


@dataclass(frozen=True)
class FunctionAdapter:
    """A plain function as the method of a stage; several threads call it unless ``threads=1``."""

    # No setting in text, where the function names the adapter.
    function: Callable[..., Any] = field(metadata={"given": True})

    @property
    def who(self) -> str:
        """The function in a message."""
        return f"the function {name_of(self)}"


@dataclass(frozen=True)
class FunctionDetector(FunctionAdapter):
    """Features without seeds by a function ``f(image) -> xy[, scale, response]`` of an array (H, W, 3)."""

    def detect(self, image: Image) -> Features:
        """See `thesisrecon.config.Detector.detect`."""
        found = self.function(image.rgb)
        parts = found if isinstance(found, tuple) else (found,)
        if not 1 <= len(parts) <= 3:
            raise _wrong("features", self.who, f"{len(parts)} values")
        shapes: dict[str, Shape] = {"xy": ("N", 2), "scale": ("N",), "response": ("N",)}
        given = zip(shapes.items(), parts, strict=False)
        xy, *others = _arrays(self.who, **{name: (value, shape) for (name, shape), value in given})
        _require_inside(self.who, xy, image.size, "xy")
        scale, response = (one.astype(np.float32) for one in [*others, *[np.ones(len(xy))] * 2][:2])
        if (scale <= 0.0).any():
            raise _wrong("features", self.who, "a scale that is not positive")
        order = np.argsort(-response, kind="stable")
        return Features(xy[order], scale[order], response[order])


@dataclass(frozen=True)
class FunctionView:
    """Pixels at working size and features of an image, as prepared for a matching function."""

    rgb: U8
    features: Features


@dataclass(frozen=True)
class FunctionMatcher(FunctionAdapter):
    """Matches by a function ``f(image1, image2) -> xy1, xy2[, score]`` of arrays (H, W, 3) uint8.

    Tracks join positions within ``PlainTracks.merge_px``, which may differ from pair to pair. They are not
    aligned: ``AlignedTracks()`` becomes ``PlainTracks()``.
    """

    def prepare(self, image: Image, features: Features) -> FunctionView:
        """See `thesisrecon.config.Matcher.prepare`."""
        return FunctionView(image.rgb, features)

    def match(
        self, view1: FunctionView, view2: FunctionView, *, pair: tuple[int, int], estimate_fundamental: Any,
        rng: np.random.Generator,
    ) -> Matches:  # fmt: skip
        """See `thesisrecon.config.Matcher.match`."""
        sizes = [(view.rgb.shape[1], view.rgb.shape[0]) for view in (view1, view2)]
        return _matches(self.who, self.function(view1.rgb, view2.rgb), pair, sizes)


@dataclass(frozen=True)
class FunctionFundamental(FunctionAdapter):
    """F, made singular, by a function ``f(xy1, xy2) -> F, inliers`` of arrays (N, 2) px and of a mask."""

    def estimate(self, xy1: F64, xy2: F64, rng: np.random.Generator) -> FundamentalFit:
        """See `thesisrecon.config.FundamentalEstimator.estimate`."""
        xy1, xy2 = check_matches(xy1, xy2, needed=MIN_INLIERS)
        found = self.function(xy1, xy2)
        if not isinstance(found, tuple | list) or len(found) != 2:
            raise _wrong("epipolar", self.who, f"a {type(found).__name__}")
        if found[0] is None:
            raise self._failure("it returned no F", len(xy1))
        inliers: B8 = np.asarray(found[1])
        inliers = inliers[:, 0] if inliers.shape == (len(xy1), 1) else inliers
        if inliers.shape != (len(xy1),) or not np.isin(inliers, (0, 1)).all():
            raise _wrong("epipolar", self.who, f"inliers of shape {inliers.shape} for {len(xy1)} matches")
        inliers = inliers.astype(np.bool_)
        (F,) = _arrays(self.who, F=(found[0], (3, 3)))
        if inliers.sum() < MIN_INLIERS:
            raise self._failure(f"it found {inliers.sum()} inliers", len(xy1))
        frame = PairFrame.of(xy1, xy2)
        F = frame.matrix_in_frame(F).reshape(3, 3)
        s = np.linalg.svd(F, compute_uv=False)
        if not s[1] > 1e-12 * s[0]:
            raise _wrong("epipolar", self.who, "an F of rank below 2")
        f = enforce_rank_two(F).ravel()
        F = frame.matrix_in_pixels(f)
        sigma = noise_scale(sampson_residuals(F, xy1[inliers], xy2[inliers]))
        points = frame.points(xy1[inliers], xy2[inliers])
        covariance = fundamental_covariance(frame, f, points, sigma * frame.scale)
        return FundamentalFit(F, inliers, sigma, covariance)

    def _failure(self, what: str, count: int) -> StageFailure:
        return StageFailure(Notice("no-geometry-of-function", name_of(self)), f"{what} in {count} matches")


FUNCTIONS: Mapping[str, tuple[type[FunctionAdapter], tuple[str, ...], str]] = {
    "features": (FunctionDetector, ("image",), "xy (N, 2) px, or xy, scale (N,), response (N,)"),
    "matching": (FunctionMatcher, ("image1", "image2"), "xy1, xy2 (N, 2) px, or xy1, xy2, score (N,)"),
    "epipolar": (FunctionFundamental, ("xy1", "xy2"), "F (3, 3) and a mask (N,) of inliers"),
}
"""Stages that take a function: its adapter, its arguments, and its return values."""


def as_method(stage: str, value: Any, protocol: type[Any]) -> Any:
    """Return the method of a stage: a function in its adapter, or an object whose methods were checked."""
    members = {name: member for name, member in vars(protocol).items() if not name.startswith("_")}
    needed = {name: member for name, member in members.items() if isinstance(member, FunctionType)}
    missing = [name for name in needed if not callable(getattr(value, name, None))]
    if isinstance(value, type) or (missing and not (stage in FUNCTIONS and callable(value))):
        takes = f"{stage} takes an object with the method{'s' * (len(needed) > 1)} {' and '.join(needed)}"
        if stage in FUNCTIONS:
            takes += f", or a function of {', '.join(FUNCTIONS[stage][1])}"
        got = in_words(value) if isinstance(value, str | int | float | None) else f"a {type(value).__name__}"
        got += f", which has no {' and no '.join(missing)}"
        if isinstance(value, type):
            got = f"the class {value.__name__}: write {value.__name__}()"
        raise UsageError(f"{takes}; got {got}")
    if missing:
        kind, names, _ = FUNCTIONS[stage]
        fixed = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_ONLY) for name in names]
        _check_arguments(value, fixed, f"the function {stage}={name_of(value)}")
        return kind(value)
    for name, member in needed.items():
        parameters = list(inspect.signature(member).parameters.values())[1:]
        # The pipeline always passes the arguments without a default.
        fixed = [p for p in parameters if p.default is p.empty]
        what = f"the method {name} of {stage}={type(value).__name__}"
        _check_arguments(getattr(value, name), fixed, what)
    return value


def _check_arguments(function: Callable[..., Any], fixed: Sequence[inspect.Parameter], what: str) -> None:
    """A UsageError unless the function can be called with these arguments."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return  # compiled code may have none
    by_name = {p.name: None for p in fixed if p.kind is p.KEYWORD_ONLY}
    try:
        signature.bind(*[None] * (len(fixed) - len(by_name)), **by_name)
    except TypeError:
        wanted = ", ".join(p.name + "=..." * (p.kind is p.KEYWORD_ONLY) for p in fixed)
        raise UsageError(Notice("wrong-arguments", what, len(fixed), wanted, signature)) from None


def text_of(value: Any) -> str:
    """``file.py:name`` with the absolute path of a method that can be loaded again, else its name."""
    is_function = isinstance(value, FunctionAdapter)
    made = value.function if is_function else value
    home = sys.modules.get(str(getattr(made, "__module__", "")))
    file = getattr(home, "__file__", None)
    code = getattr(inspect.unwrap(made) if callable(made) else made, "__code__", None)
    # A function typed at the prompt after a script has run is in the script's module, not in its file.
    in_file = code is None or Path(code.co_filename).resolve() == Path(file or "").resolve()
    # Files of a package may need their package.
    loadable = home is not None and (is_function or "." not in home.__name__)
    if loadable and file and Path(file).is_file() and in_file:
        names = [name for name, member in vars(home).items() if member is made]
        kind = type(made).__name__
        if not is_function and is_dataclass(made) and getattr(home, kind, None) is type(made):
            names = [kind]
        if names:
            return f"{Path(file).resolve()}:{names[0]}"
    return name_of(made) + NOT_IN_A_FILE * is_function


def is_reference(kind: Any) -> bool:
    """Whether a text names something in a file: ``file.py:name``."""
    return isinstance(kind, str) and kind.rpartition(":")[0].endswith(".py")


def load_reference(reference: str, where: str) -> Any:
    """Run ``file.py`` and return the object ``name`` that it defines, for a reference ``file.py:name``."""
    file, _, name = reference.rpartition(":")
    path = Path(file).expanduser().resolve()
    if not path.is_file():
        raise UsageError(f"{where}={reference}: there is no file {file}")
    module = _module_of(path, where)
    if not hasattr(module, name):
        own = [k for k, v in vars(module).items() if getattr(v, "__module__", None) == module.__name__]
        raise UsageError(f"{where}={reference}: {unknown_word(f'name in {file}', name, own or ['none'])}")
    return getattr(module, name)


def _module_of(path: Path, where: str) -> ModuleType:
    """The module of a file, imported once, by its name as worker processes import it, and those beside it."""
    for module in list(sys.modules.values()):
        file = getattr(module, "__file__", None)
        if file and Path(file).name == path.name and Path(file).resolve() == path:
            return module
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    importlib.invalidate_caches()
    try:
        found = importlib.import_module(path.stem)
    except Exception as error:
        # A user's file may raise anything.
        raise UsageError(f"{where}: {path} cannot be imported: {type(error).__name__}: {error}") from None
    if Path(getattr(found, "__file__", None) or "").resolve() != path:
        raise UsageError(f"{where}: another module is called {path.stem}; rename {path.name}")
    return found
