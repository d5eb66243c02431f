"""What the steps of one run hand on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.assumptions import assumptions_of_views
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure, counted
from thesisrecon.io.images import PhotographSet
from thesisrecon.pipeline.prepared import PreparedViews
from thesisrecon.run import Run
from thesisrecon.types import Assumptions, RunResult


@dataclass
class Work:
    """What the steps of one run hand on: ``result`` grows, the rest is what they need beside it."""

    run: Run
    photographs: PhotographSet
    result: RunResult
    until: str
    prepared: PreparedViews | None = None

    @property
    def config(self) -> PipelineConfig:
        return self.run.config

    @property
    def assumed(self) -> Assumptions:
        """What the user lets us assume of the cameras."""
        scales = np.array([image.scale for image in self.result.images])
        sizes = [image.original_size for image in self.result.images]
        return assumptions_of_views(self.config.intrinsics, sizes, self.photographs.exif_focal_px, scales)

    def check_photographs(self) -> None:
        """Refuse what is too little before anything is computed."""
        found, needed = len(self.result.images), 1 if self.until == "features" else 2
        if found < needed:
            refused = list(self.result.refused.items())
            told = [f"{name} {reason}" for name, reason in refused[:3]]
            why = "; ".join([*told, f"and {len(refused) - 3} more"] if len(refused) > 3 else told)
            wanted = "two different ones are" if needed == 2 else "one is"
            raise StageFailure(
                counted(found, "usable photograph") if found else "no usable photographs",
                f"at least {wanted} needed{'; ' + why if why else ''}",
                "take more photographs of the scene from other places",
            )
