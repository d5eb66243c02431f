"""A job of Algorithm 1: a run, its images, and where their features, matches and tracks come from."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from thesisrecon.arrays import I64
from thesisrecon.config import PipelineConfig
from thesisrecon.config.intrinsics import prior_from_options
from thesisrecon.errors import Notice, StageFailure, counted
from thesisrecon.io._images import ImageSet
from thesisrecon.pipeline.run import Run, Until
from thesisrecon.records import Features, Image, IntrinsicsPrior, PairChoice, Tracks, TwoView


class FrontEnd(Protocol):
    """The first stages of Algorithm 1: computed from images, or taken from other programs or another run."""

    @property
    def divides(self) -> bool:
        """Whether groups of images that do not overlap are reconstructed one by one."""
        ...

    def detect(self, job: Job) -> Sequence[Features]:
        """Features of each image (4.2.1)."""
        ...

    def prepare(self, job: Job, features: Sequence[Features]) -> Sequence[Any]:
        """The views as matching and tracks take them, made when they are used."""
        ...

    def select(self, job: Job, features: Sequence[Features]) -> PairChoice | None:
        """The pairs of images to match."""
        ...

    def match(self, job: Job, views: Sequence[Any], choice: PairChoice | None) -> Sequence[TwoView]:
        """Matches and epipolar geometry of the pairs (4.2.2, chapter 5)."""
        ...

    def track(
        self, job: Job, views: Sequence[Any], pairs: Sequence[TwoView], among: Sequence[int] | None = None
    ) -> Tracks:
        """Tracks through the accepted pairs; ``among``: images of this front end that the job consists of."""
        ...


@dataclass(frozen=True)
class Job:
    """What Algorithm 1 works on, and the last stage that is wanted."""

    run: Run
    inputs: ImageSet
    front: FrontEnd
    until: Until
    surface_required: bool = False  # whether a surface that fails is a failure; otherwise it is a warning
    known: IntrinsicsPrior | None = None
    """Prior of the intrinsics, if another model determined them."""

    @property
    def config(self) -> PipelineConfig:
        """The settings of the run."""
        return self.run.config

    @cached_property
    def images(self) -> Sequence[Image]:
        """The images at working size."""
        return self.inputs.images

    @property
    def names(self) -> list[str]:
        """File names of the images."""
        return [image.name for image in self.images]

    @cached_property
    def sizes(self) -> I64:
        """Working sizes (V, 2) of the images."""
        return np.array([image.size for image in self.images], dtype=np.int64)

    @cached_property
    def prior(self) -> IntrinsicsPrior:
        """Prior of the intrinsics at working size."""
        if self.known is not None:
            return self.known
        scales = np.array([image.scale for image in self.images])
        sizes = [image.original_size for image in self.images]
        return prior_from_options(self.config.intrinsics, sizes, self.inputs.exif_focal_px, scales)

    def require_images(self) -> None:
        """Raise ``StageFailure`` if there are fewer than two images (one, if only features are detected)."""
        found, needed = len(self.images), 1 if self.until == "features" else 2
        if found < needed:
            unread = [f"{name} {reason}" for name, reason in self.inputs.refused.items()]
            why = "; ".join([*unread[:3], f"and {len(unread) - 3} more"] if len(unread) > 3 else unread)
            wanted = "two different ones are" if needed == 2 else "one is"
            reason = counted(found, "usable image") if found else "no usable images"
            evidence = f"at least {wanted} needed{'; ' + why if why else ''}"
            raise StageFailure(reason, evidence, "add images of the scene from other places")


def name_images(text: str, names: Sequence[str]) -> str:
    """Replace the image numbers (``#number``) in a sentence of a stage by file names."""
    # A file name such as "a #1.jpg" in the sentence is left alone.
    named = re.sub(
        r"(?<![^\s(])#(\d+)(?!\.?\w)", lambda m: names[int(m[1])] if int(m[1]) < len(names) else m[0], text
    )
    return Notice.of(text.code, named) if isinstance(text, Notice) else named
