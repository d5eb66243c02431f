"""What matching needs of the photographs, made when it is asked for and kept within bounds.

What the steps of one run hand on.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, overload

import numpy as np

from thesisrecon.config import Matcher, PipelineConfig
from thesisrecon.errors import StageFailure, counted
from thesisrecon.intrinsics import IntrinsicsPrior, prior_from_options
from thesisrecon.io.images import ImageSet
from thesisrecon.numerics.observations import morton_pair_order
from thesisrecon.records import Features, Image, RunResult
from thesisrecon.runtime.run import Run

KEPT_BYTES = 2**30
"""What is prepared takes several times the room of its photograph, and takes little time to make again."""
LARGEST_BATCH = 64
BATCHES_PER_WORKER = 8


class PreparedViews(Sequence[Any]):
    """What ``matching`` prepares of each view: those asked for last stay, as far as ``KEPT_BYTES`` go.

    It travels without what it has prepared, and :meth:`part` of it with some of its photographs alone.
    """

    def __init__(self, matching: Matcher, given: Mapping[int, tuple[Image, Features]]) -> None:
        self._matching, self._given = matching, dict(given)
        self._forget()

    def _forget(self) -> None:
        self._kept: OrderedDict[int, tuple[Any, int]] = OrderedDict()
        self._lock, self._bytes = threading.Lock(), 0

    def __getstate__(self) -> tuple[Matcher, dict[int, tuple[Image, Features]]]:
        return self._matching, self._given

    def __setstate__(self, state: tuple[Matcher, dict[int, tuple[Image, Features]]]) -> None:
        self._matching, self._given = state
        self._forget()

    def __len__(self) -> int:
        return len(self._given)

    def __iter__(self) -> Iterator[Any]:
        return (self[view] for view in sorted(self._given))

    @overload
    def __getitem__(self, view: int) -> Any: ...
    @overload
    def __getitem__(self, view: slice) -> Sequence[Any]: ...
    def __getitem__(self, view: int | slice) -> Any:
        if isinstance(view, slice):
            return [self[v] for v in sorted(self._given)[view]]
        if view not in self._given:
            raise IndexError(f"there is no view {view} here")
        with self._lock:
            if view in self._kept:
                self._kept.move_to_end(view)
                return self._kept[view][0]
        # Two threads may both make it: that costs less than one that waits for the other.
        made = self._matching.prepare(*self._given[view])
        with self._lock:
            if view not in self._kept:
                self._kept[view] = made, _size_of(made)
                self._bytes += self._kept[view][1]
            while self._bytes > KEPT_BYTES and len(self._kept) > 2:
                self._bytes -= self._kept.popitem(last=False)[1][1]
        return made

    def part(self, views: Iterable[int]) -> PreparedViews:
        """The same for these views alone."""
        return PreparedViews(self._matching, {view: self._given[view] for view in views})


def _size_of(value: Any) -> int:
    """Bytes of the arrays of a record."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if is_dataclass(value):
        return sum(_size_of(getattr(value, f.name)) for f in fields(value))
    return 0


def near_in_pairs(pairs: Sequence[tuple[int, int]], numbers: Sequence[int]) -> list[int]:
    """The numbers in an order in which what was prepared of a view serves again."""
    first, second = ([pairs[n][side] for n in numbers] for side in (0, 1))
    return [numbers[k] for k in morton_pair_order(first, second)]


def batches_of_pairs(
    pairs: Sequence[tuple[int, int]], numbers: Sequence[int], workers: int
) -> list[list[int]]:
    """The numbers dealt into batches whose pairs have views in common, enough of them for all workers."""
    size = min(max(len(numbers) // (BATCHES_PER_WORKER * workers), 1), LARGEST_BATCH)
    ordered = near_in_pairs(pairs, numbers)
    return [ordered[k : k + size] for k in range(0, len(ordered), size)]


@dataclass
class Work:
    """What the steps of one run hand on: ``result`` grows, the rest is what they need beside it."""

    run: Run
    photographs: ImageSet
    result: RunResult
    until: str
    prepared: PreparedViews | None = None

    @property
    def config(self) -> PipelineConfig:
        return self.run.config

    @property
    def prior(self) -> IntrinsicsPrior:
        """What the user lets us assume of the cameras."""
        scales = np.array([image.scale for image in self.result.images])
        sizes = [image.original_size for image in self.result.images]
        return prior_from_options(self.config.intrinsics, sizes, self.photographs.exif_focal_px, scales)

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
