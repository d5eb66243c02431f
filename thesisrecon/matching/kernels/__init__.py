"""Compiled loops of the matching; every one has a NumPy twin in the tests.

One module a purpose. numba keys its cache by the file of the outermost function alone: after an edit of
``windows`` the modules that call it must be touched too, or their old code goes on being used.
"""

from __future__ import annotations

from thesisrecon.matching.kernels.alignment import align_windows
from thesisrecon.matching.kernels.chains import chain_maps, unite
from thesisrecon.matching.kernels.correlation import scan_correlations, update_column_best
from thesisrecon.matching.kernels.growth import fit_local_affines, grow_corners
from thesisrecon.matching.kernels.strength import (
    displacement_weight,
    relative_difference_weight,
    strength_of_match,
)
from thesisrecon.matching.kernels.windows import SAMPLES, SIDE, corner_patches

__all__ = [
    "SAMPLES",
    "SIDE",
    "align_windows",
    "chain_maps",
    "corner_patches",
    "displacement_weight",
    "fit_local_affines",
    "grow_corners",
    "relative_difference_weight",
    "scan_correlations",
    "strength_of_match",
    "unite",
    "update_column_best",
]
