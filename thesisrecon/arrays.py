"""Names of NumPy array types, the arrays of callers read and checked, and records that compare by value."""

from collections.abc import Mapping
from dataclasses import fields
from importlib import import_module
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]
I16 = NDArray[np.int16]
B8 = NDArray[np.bool_]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
U32 = NDArray[np.uint32]

Stratum = Literal["projective", "affine", "metric"]


class Record:
    """Base of frozen dataclasses with arrays: ``==`` compares all fields by value, NaN equal to NaN.

    Records have no hash, as lists and arrays have none. ``repr`` is one line of at most 200 characters.
    """

    def __init_subclass__(cls) -> None:
        # A dataclass makes no repr, of pages of numbers, for a class that has its own.
        cls.__repr__ = cls.__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        shown = [f"{f.name}={_short(getattr(self, f.name))}" for f in fields(self) if f.repr]  # type: ignore[arg-type]
        return cut_text(f"{type(self).__name__}({', '.join(shown)})")

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        names = (field.name for field in fields(self) if field.compare)  # type: ignore[arg-type]
        return all(_equal(getattr(self, name), getattr(other, name)) for name in names)

    __hash__ = None  # type: ignore[assignment]

    def _repr_html_(self) -> str | None:
        # Pictures are above the records, and notebooks load them.
        found: str | None = import_module("thesisrecon.plot").html(self)
        return found


def _short(value: Any) -> str:
    """A value in a few words: the shape of an array, the length of a sequence or mapping."""
    if isinstance(value, np.ndarray) and value.ndim:
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, tuple | list | Mapping) and value:
        numbers = len(value) < 5 and all(isinstance(one, int | float) for one in value)
        return f"{value}" if numbers else f"<{len(value)} of {type(next(iter(value))).__name__}>"
    if isinstance(value, float | np.floating):
        return f"{value:.6g}"
    return type(value).__name__ if isinstance(value, Record) else cut_text(repr(value), 60)


def cut_text(text: str, most: int = 200) -> str:
    """Cut a text to a number of characters."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def _equal(a: Any, b: Any) -> bool:
    if a is b:
        return True
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return np.array_equal(a, b, equal_nan=np.asarray(a).dtype.kind in "fc")
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(_equal(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(map(_equal, a, b))
    return bool(a == b) or (isinstance(a, float) and a != a and b != b)


def numbers(caller: str, *, missing: tuple[str, ...] = (), **arrays: Any) -> list[F64]:
    """Read arrays of real numbers in double precision: arrays, lists, and what has ``__array__``.

    The values that a numpy mask hides, and None, are NaN in the arrays of ``missing``; in the others they are
    a ``ValueError``, as are complex numbers, words and lists of different lengths.
    """
    return [_real(caller, name, value, name in missing) for name, value in arrays.items()]


def whole_numbers(caller: str, name: str, value: Any) -> I64:
    """Read an array of whole numbers."""
    (found,) = numbers(caller, **{name: value})
    if not (np.isfinite(found).all() and (found == np.rint(found)).all() and (np.abs(found) < 2**53).all()):
        raise ValueError(f"{caller} needs whole numbers as {name}; some are none")
    return found.astype(np.int64)


def number_or_numbers(caller: str, name: str, value: Any) -> F64:
    """Read a number, without axes, or an array of numbers."""
    try:
        return np.array(number(caller, name, value))
    except ValueError:
        return numbers(caller, **{name: value})[0]


_LARGEST = np.float64(1e100)  # Squares and products of a few such numbers are finite


def are_finite(*values: Any) -> bool:
    """Whether all numbers of a file are finite, and their squares and products, too."""
    return all(bool((np.abs(one) <= _LARGEST).all()) for one in values)


def _read(value: Any) -> tuple[Any, B8]:
    """What ``__array__`` gives and its mask hides; an array of objects if it cannot be read."""
    try:
        hidden = np.ma.getmaskarray(value) if isinstance(value, np.ma.MaskedArray) else np.zeros(0, bool)
        found = np.asarray(value)
        return found.astype(np.float64) if found.dtype.kind in "OV" and found.ndim else found, hidden
    except Exception:
        # Tensors that are not in the memory of the processor raise errors of any kind.
        return np.empty(0, dtype=object), np.zeros(0, bool)


def _real(caller: str, name: str, value: Any, missing: bool) -> F64:
    if isinstance(value, list | tuple) and any(isinstance(one, np.ma.MaskedArray) for one in value):
        value = np.ma.stack(value) if len({np.shape(one) for one in value}) == 1 else value
    found, hidden = _read(value)
    if found.dtype.kind not in "biuf" or value is None or not found.ndim:
        kind = "complex numbers" if found.dtype.kind == "c" else f"{value!r}" if not found.ndim else ""
        kind = kind or f"a {type(value).__name__} of {found.dtype}"
        raise ValueError(f"{caller} needs an array of real numbers as {name}; got {kind}")
    if hidden.any() and not missing:
        count = f"{int(hidden.sum())} of {hidden.size} are hidden by its mask"
        raise ValueError(f"{caller} needs all values of {name}, but {count}; leave out these rows")
    real = np.ascontiguousarray(found, dtype=np.float64)
    if np.any(np.abs(real[np.isfinite(real)]) > _LARGEST):
        raise ValueError(f"{caller} needs numbers of at most {_LARGEST:g} as {name}; some are larger")
    return np.where(hidden, np.nan, real) if hidden.any() else real


def generator(caller: str, seed: Any) -> np.random.Generator:
    """The random generator of a seed, or the one that was given."""
    if isinstance(seed, np.random.Generator):
        return seed
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        rule = "a whole number of at least 0, or a numpy.random.Generator, as seed"
        raise ValueError(f"{caller} needs {rule}; got {seed!r}")
    return np.random.default_rng(int(seed))


def number(caller: str, name: str, value: Any, rule: str = "a number") -> float:
    """Read one real number, which may be NaN; ``ValueError`` with the rule for anything else."""
    # Tensors of one number have no axes.
    if isinstance(value, str | bytes | bool | complex) or getattr(value, "shape", ()) != ():
        raise ValueError(f"{caller} needs {rule} as {name}; got {value!r}")
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{caller} needs {rule} as {name}; got {value!r}") from None


def whole_number(caller: str, name: str, value: Any, least: int) -> int:
    """Read a whole number of at least ``least``."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{caller} needs a whole number of at least {least} as {name}; got {value!r}")
    return int(value)


def flag(caller: str, name: str, value: Any) -> bool:
    """Read True or False."""
    if not isinstance(value, bool | np.bool_ | int):
        raise ValueError(f"{caller} needs True or False as {name}; got {value!r}")
    return bool(value)


def image_levels(*images: Any) -> list[U8 | F32]:
    """Read arrays of images or colours as levels from 0 to 255, of one scale for all of a kind.

    Unsigned bytes stay; other whole numbers have the range of the fewest bits that hold the largest; floats
    are 0 to 1, 0 to 255 or 0 to 65535 by their largest. Floats are single precision, NaN where missing or
    hidden by a mask. ``ValueError`` for other ranges and kinds.
    """
    given = [_level_array(image) for image in images]
    whole = [a for a in given if a.dtype.kind in "iu" and a.dtype != np.uint8]
    real = [a for a in given if a.dtype.kind == "f"]
    white = {"b": 1.0, "i": _white_of(whole), "f": _white_of(real)}
    read: list[U8 | F32] = []
    for array in given:
        scale = 255.0 / white["i" if array.dtype.kind == "u" else array.dtype.kind]
        if array.dtype == np.uint8:
            read.append(array)
        elif array.dtype.kind in "bui" and scale in (1.0, 255.0):
            read.append((array * np.uint16(scale)).astype(np.uint8))
        else:
            read.append(np.asarray(array * scale, dtype=np.float32))
    return read


def eight_bit(levels: U8 | F32) -> tuple[U8, B8 | None]:
    """Rounded levels from 0 to 255, and the pixels (H, W) in which none is missing; None: all."""
    if levels.dtype == np.uint8:
        return np.asarray(levels, dtype=np.uint8), None
    known = np.isfinite(levels)
    whole: U8 = np.rint(np.clip(np.where(known, levels, 128.0), 0.0, 255.0)).astype(np.uint8)
    return whole, None if known.all() else np.asarray(known if known.ndim == 2 else known.all(axis=2))


def _level_array(image: Any) -> Any:
    array, hidden = _read(image)
    if array.dtype.kind not in "biuf":
        kinds = "a path, a Pillow image or a numpy array of grey levels or colours"
        raise ValueError(f"an image must be {kinds}; got a {type(image).__name__} of {array.dtype}")
    if hidden.any():
        array = np.where(hidden, np.nan, array.astype(np.float32))
    if array.dtype.kind == "f" and array.size and not np.isfinite(array).any():
        raise ValueError("an image array has no finite level: all of them are missing")
    return array


def _white_of(arrays: list[Any]) -> float:
    """White of whole or real levels: 1, 255 or by the bits of the largest; ``ValueError`` of other ranges."""
    known = np.array([[a.min(), a.max()] for a in (a[np.isfinite(a)] for a in arrays) if a.size], np.float64)
    if not len(known):
        return 255.0
    low, high = float(known[:, 0].min()), float(known[:, 1].max())
    real = arrays[0].dtype.kind == "f"
    # Resampled levels exceed their range a little.
    if real and low >= -0.5 and high <= 1.5:
        return 1.0
    if (-128.0 if real and high > 1.5 else 0.0) <= low and high <= 65535.5:
        # Of whole numbers 2^n - 1 of the fewest bits, at least 8.
        return 255.0 if real and high < 512.0 else 2.0 ** max(8, int(high).bit_length()) - 1.0
    ranges = "0 to 1 (floats), 0 to 255 or 0 to 65535"
    raise ValueError(f"the levels of an image must be {ranges}; got {low:g} to {high:g}")


def rows_of_views(view: I64, n_views: int) -> list[I64]:
    """The rows of ``view`` (K,) with each view, in their order."""
    ends = np.cumsum(np.bincount(view, minlength=n_views))
    return np.split(np.argsort(view, kind="stable"), ends[:-1])


def distinct_corners(vertex: I64, uv: F64 | I64) -> tuple[I64, I64]:
    """First corner of each distinct pair of vertex (K,) and texel (K, 2), and number (K,) of each pair."""
    # Three sorted columns are faster than np.unique of rows.
    order = np.lexsort((uv[:, 1], uv[:, 0], vertex))
    new = np.ones(len(order), dtype=bool)
    new[1:] = (np.diff(vertex[order]) != 0) | (np.diff(uv[order], axis=0) != 0.0).any(axis=1)
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.cumsum(new) - 1
    return order[new], number


def require_shapes(caller: str, **arrays: tuple[ArrayLike, tuple[int | str, ...]]) -> None:
    """Raise ``ValueError`` if an array has a wrong shape; equal letters are equal sizes."""
    sizes: dict[str, int] = {}
    for array, shape in arrays.values():
        actual = np.shape(array)
        expected = (
            sizes.setdefault(d, n) if isinstance(d, str) else d for d, n in zip(shape, actual, strict=False)
        )
        if len(actual) != len(shape) or tuple(expected) != actual:
            break
    else:
        return
    needed = ", ".join(f"{name} ({', '.join(map(str, shape))})" for name, (_, shape) in arrays.items())
    got = ", ".join(str(np.shape(array)) for array, _ in arrays.values())
    raise ValueError(f"{caller} needs {needed}; got {got}")


def checked(
    caller: str, *, missing: tuple[str, ...] = (), **arrays: tuple[Any, tuple[int | str, ...]]
) -> list[F64]:
    """Read arrays as :func:`numbers`, of these shapes (equal letters are equal sizes) and finite.

    Those of ``missing`` may hold NaN and infinite numbers.
    """
    found = numbers(caller, missing=missing, **{name: value for name, (value, _) in arrays.items()})
    named = zip(arrays.items(), found, strict=True)
    require_shapes(caller, **{name: (array, shape) for (name, (_, shape)), array in named})
    require_finite(caller, *(array for name, array in zip(arrays, found, strict=True) if name not in missing))
    return found


def require_finite(caller: str, *arrays: F64) -> None:
    """Raise ``ValueError`` if an entry is NaN or infinite."""
    if not all(np.isfinite(array).all() for array in arrays):
        raise ValueError(f"{caller} needs finite numbers; some are NaN or infinite")


def require_calibration(caller: str, K: F64) -> None:
    """Raise ``ValueError`` if K is not upper triangular with positive focal lengths and K33 = 1."""
    require_shapes(caller, K=(K, (3, 3)))
    require_finite(caller, K)
    K = np.asarray(K, dtype=np.float64)
    low = np.append(K[[1, 2, 2], [0, 0, 1]], K[2, 2] - 1.0)
    if not (min(K[0, 0], K[1, 1]) > 0.0 and np.abs(low).max() <= 1e-9):
        needed = "K upper triangular with positive focal lengths and K33 = 1"
        raise ValueError(f"{caller} needs {needed}; got {K.round(6).tolist()}")


def require_rotations(caller: str, R: F64) -> None:
    """Raise ``ValueError`` if a matrix of R (..., 3, 3) is no rotation."""
    apart = float(np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(initial=0.0))
    # Four printed digits leave at most 2 sqrt(3) 5e-5.
    if not apart <= 2e-4:
        raise ValueError(f"{caller} needs a rotation R; R'R deviates from the identity by {apart:.2g}")
    if not (np.linalg.det(R) > 0.0).all():
        raise ValueError(f"{caller} needs a rotation R; got a reflection, det R = -1")


def sizes_of_images(sizes: Any) -> Any:
    """(width, height) of an image, or of each of a list or stack of images; other values stay as they are."""

    def one(image: Any) -> Any:
        if isinstance(image, np.ndarray) and image.ndim > 1:
            return image.shape[1], image.shape[0]
        size = getattr(image, "size", None)
        return size if isinstance(size, tuple) else image

    if isinstance(sizes, list | tuple):
        return [one(item) for item in sizes]
    if not isinstance(sizes, np.ndarray):
        return one(sizes)
    if sizes.ndim == 2 and sizes.shape[1] == 2:
        return sizes
    stacked = sizes.ndim == 4 or (sizes.ndim == 3 and sizes.shape[2] not in (1, 3, 4))
    return one(sizes[0] if stacked else sizes) if sizes.size else sizes


def resizing_transform(scale: float | F64) -> F64:
    """Transform (3, 3) to the pixels of an image resized by s, one or (2,) for x and y: (x + 0.5) s - 0.5."""
    T: F64 = np.diag(np.append(np.broadcast_to(scale, 2), 1.0))
    T[:2, 2] = 0.5 * T.diagonal()[:2] - 0.5
    return T
