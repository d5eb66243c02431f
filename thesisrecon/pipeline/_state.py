"""The state shared by the steps of a run, and the prepared views of the matching stage."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from thesisrecon.arrays import B8, F64
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import Notice, StageFailure, counted
from thesisrecon.imaging.on_demand import RecentlyUsed
from thesisrecon.intrinsics import IntrinsicsPrior, prior_from_options
from thesisrecon.io._images import ImageSet
from thesisrecon.optimize.bundle.observations import cached_pair_order
from thesisrecon.records import Features, Image, TwoView
from thesisrecon.results import RunResult
from thesisrecon.runtime._run import Run

CACHE_BYTES = 2**30
"""Prepared views take several times the memory of their image and are quickly prepared again."""
Prepare = Callable[[Image, Features], Any]
MAX_BATCH = 64
BATCHES_PER_WORKER = 8
MAX_RESULT_BYTES = 2**25
"""Pickled bytes of the result of a batch of pairs, at most."""
PAIR_BYTES, MATCH_BYTES = 2**14, 80
"""Pickled bytes of a :class:`TwoView` without matches, at most, and of each match."""


class PreparedViews(Sequence[Any]):
    """Views prepared for matching on demand, in a least-recently-used cache that is never pickled."""

    def __init__(self, prepare: Prepare, given: Mapping[int, tuple[Image, Features]]) -> None:
        self._prepare, self._given = prepare, dict(given)
        self._made: RecentlyUsed[int, Any] = RecentlyUsed(CACHE_BYTES)

    def __reduce__(self) -> tuple[type[PreparedViews], tuple[Prepare, dict[int, tuple[Image, Features]]]]:
        return PreparedViews, (self._prepare, self._given)

    def __len__(self) -> int:
        return len(self._given)

    def __getitem__(self, view: int) -> Any:  # type: ignore[override]
        if view not in self._given:
            raise IndexError(f"view {view} is not among those given")
        return self._made.get(view, lambda: self._prepare(*self._given[view]))

    def masks(self, i: int, j: int) -> tuple[B8 | None, B8 | None]:
        """Masks of two views, None: all pixels."""
        return self._given[i][0].mask, self._given[j][0].mask

    def subset(self, views: Iterable[int]) -> PreparedViews:
        """The same for some views, with an empty cache."""
        return PreparedViews(self._prepare, {view: self._given[view] for view in views})


def batch_pairs(
    pairs: Sequence[tuple[int, int]], numbers: Sequence[int], workers: int | None, corners: Sequence[int]
) -> list[list[int]]:
    """Divide the ``numbers`` of pairs into batches, each of pairs of few different views.

    The smaller view is first in a pair. A corner is matched once in a pair, so the ``corners`` of each view
    bound the bytes of a result. ``workers`` None: batches of one pair, in an order that reuses cached views.
    """
    first, second = ([pairs[n][side] for n in numbers] for side in (0, 1))
    left = {pairs[numbers[k]]: numbers[k] for k in cached_pair_order(first, second)}
    if workers is None:
        return [[n] for n in left.values()]
    size = min(max(len(numbers) // (BATCHES_PER_WORKER * workers), 1), MAX_BATCH)
    near: dict[int, set[int]] = {view: set() for pair in left for view in pair}
    for i, j in left:
        near[i].add(j)
        near[j].add(i)
    batches = []
    while left:
        batch, room = list[int](), MAX_RESULT_BYTES
        for i, j in _pairs_of_few_views(left, near):
            room -= PAIR_BYTES + MATCH_BYTES * min(corners[i], corners[j])
            if len(batch) == size or (batch and room < 0):
                break
            batch.append(left.pop((i, j)))
            near[i].remove(j)
            near[j].remove(i)
        batches.append(batch)
    return batches


def _pairs_of_few_views(
    left: Mapping[tuple[int, int], int], near: Mapping[int, set[int]]
) -> Iterator[tuple[int, int]]:
    """Yield pairs of a growing set of views; the view added next has most pairs with the set and few others.

    The caller removes each pair from ``left`` and from ``near`` (view -> views of its pairs).
    """
    views, ties = set[int](), Counter[int]()
    while left:
        added: tuple[int, ...]
        if ties:
            added = (max(ties, key=lambda view: (ties[view], -len(near[view]), -view)),)
            for view in sorted(views & near[added[0]]):
                yield min(view, *added), max(view, *added)
        else:
            added = first = next(iter(left))
            yield first
        views.update(added)
        for view in added:
            del ties[view]
            ties.update(near[view])


@dataclass
class PipelineState:
    """The state shared by the steps of one run; each step adds to ``result``."""

    run: Run
    inputs: ImageSet
    result: RunResult
    until: str
    prepared: Sequence[Any] | None = None
    groups: Sequence[Sequence[int]] = ()
    """Views of the groups of images that do not overlap, the largest first; empty if there is one."""
    views: Sequence[int] | None = None
    """Numbers of the images in the run that this one is a part of."""
    focals: F64 | None = None
    """Focal lengths of the same cameras in another model, and relative standard deviations (V, 2), or NaN."""

    @property
    def config(self) -> PipelineConfig:
        """The run's settings."""
        return self.run.config

    @property
    def names(self) -> list[str]:
        """File names of the images."""
        return [image.name for image in self.result.images]

    @property
    def used_pairs(self) -> tuple[TwoView, ...]:
        """The matched pairs, those of the largest group if there are several."""
        pairs = self.result.pairs
        return tuple(p for p in pairs if {p.i, p.j} <= set(self.groups[0])) if self.groups else pairs

    def given(self) -> dict[int, tuple[Image, Features]]:
        """Image and features of each view."""
        return dict(enumerate(zip(self.result.images, self.result.features, strict=True)))

    def prepared_views(self) -> Sequence[Any]:
        """The views prepared for matching, which tracks are aligned with."""
        if self.prepared is None:
            self.prepared = PreparedViews(self.config.matching.prepare, self.given())
        return self.prepared

    @property
    def prior(self) -> IntrinsicsPrior:
        """Prior of the intrinsics at working size."""
        scales = np.array([image.scale for image in self.result.images])
        sizes = [image.original_size for image in self.result.images]
        prior = prior_from_options(self.config.intrinsics, sizes, self.inputs.exif_focal_px, scales)
        if self.focals is not None:
            better = self.focals[:, 1] < prior.std[:, 0]
            prior.mean[better, 0], prior.std[better, 0] = self.focals[better].T
        return prior

    def require_images(self) -> None:
        """Raise ``StageFailure`` if there are fewer than two images (one, if only features are detected)."""
        found, needed = len(self.result.images), 1 if self.until == "features" else 2
        if found < needed:
            unread = [f"{name} {reason}" for name, reason in self.result.unread.items()]
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
