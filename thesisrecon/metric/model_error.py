"""What the model of the camera leaves out: whether the data show it, and how far it may move an intrinsic.

What all parts of a scene have in common shows in no scatter. A floor stands for it, but only where the data
are seen to be more than a right model and normal noise. A value that one photograph holds alone feels an
error of the model more than that of a camera behind all of them: its floor is higher by the root of what its
standard deviation is (an error of the lens is common to all, one of the matches is each photograph's own).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.metric.model import CENTRE, SKEW, MetricModel
from thesisrecon.optimize.bundle_blocks import BlockScatter

F64 = NDArray[np.float64]

USUAL_INFLATION = 4.0
"""By how much the standard deviations of a bundle adjustment are taken to be too small on photographs where
nothing measures it: 2 to 5 is what the scatter shows where it does."""
# Below this the blocks of a scene say nothing.
LEAST_BLOCKS = 4
# The contradiction of noise alone keeps below the first; at the second the model is surely wrong somewhere.
CONTRADICTION = (1.3, 1.8)
# The same of the residuals' tail: normal noise has 1, matches of photographs 2 to 3.
TAIL = (1.2, 1.6)


def model_error_share(scatter: BlockScatter, tail: float) -> float:
    """0 where nothing but normal noise is seen, 1 where the model of camera and noise is surely not the whole
    truth."""
    if scatter.blocks < LEAST_BLOCKS or not np.isfinite(scatter.contradiction):
        return 1.0
    signs = [(scatter.contradiction, CONTRADICTION), (tail, TAIL)]
    return max(float(np.clip((sign - low) / (high - low), 0.0, 1.0)) for sign, (low, high) in signs)


def model_error_floor(model: MetricModel, scatter: BlockScatter, floor_rel: float) -> F64:
    """(G, C) standard deviation that the model's error gives each intrinsic (the focal's relative).

    ``floor_rel`` is that of one camera behind all photographs, relative to the focal; k1's is as large.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        alone = np.maximum(np.nan_to_num(scatter.model / scatter.tied), 1.0) ** 0.25
    units = np.ones_like(model.cameras.intrinsics)
    units[:, (SKEW, *CENTRE)] = model.cameras.intrinsics[:, :1]
    return np.asarray(floor_rel * model_error_share(scatter, model.tail) * alone * units)
