"""A texture that is laid out and waits for its colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.types import F64, I64


@dataclass(frozen=True)
class Charts:
    """Where the M faces of a mesh lie in their texture.

    ``label`` (M,) the view that each face is cut out of, -1 for none; ``chart`` (M,) its piece; ``uv``
    (M, 3, 2) texels of its corners; ``cut_out`` (H, W, 3) uint8 the texture with the rectangle about each
    piece as its photograph has it.
    """

    label: I64
    chart: I64
    uv: F64
    cut_out: NDArray[np.uint8]
