"""Arrays that the functions of this folder cannot compute with are a ``ValueError`` that names the caller."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import require_finite


def checked_inverse(G: F64, caller: str) -> F64:
    """Invert matrices (..., d, d) that are finite and not singular."""
    require_finite(caller, G)
    try:
        return np.asarray(np.linalg.inv(G), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise ValueError(f"{caller} needs an invertible matrix; got a singular one of {G.shape}") from error


def checked_unit(array: F64, caller: str) -> F64:
    """Scale an array that is finite and not zero to unit Frobenius norm."""
    require_finite(caller, array)
    norm = float(np.linalg.norm(array))
    if not norm > 0.0:
        raise ValueError(f"{caller} needs numbers that are not all zero")
    return array / norm
