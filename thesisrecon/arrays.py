"""Names of NumPy array types, checks of shapes and values, and rows of arrays by image number."""

from __future__ import annotations

from typing import Literal

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
U64 = NDArray[np.uint64]

Stratum = Literal["projective", "affine", "metric"]


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


def resizing_transform(scale: float | F64) -> F64:
    """Transform (3, 3) to the pixels of an image resized by s, one or (2,) for x and y: (x + 0.5) s - 0.5."""
    T: F64 = np.diag(np.append(np.broadcast_to(scale, 2), 1.0))
    T[:2, 2] = 0.5 * T.diagonal()[:2] - 0.5
    return T
