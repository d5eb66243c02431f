"""Pairs that need no look at the photographs: all of them, neighbours in a sequence, a list of the user."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from thesisrecon.errors import UsageError
from thesisrecon.matching.pair_selection.records import MapAll, every_pair, pair_array
from thesisrecon.types import Features, PairChoice

# ruff: noqa: ARG002 (a choice takes what every choice is given)


@dataclass(frozen=True)
class AllPairs:
    """Every photograph with every other: N (N - 1) / 2 pairs."""

    def check(self, names: Sequence[str], left_out: Collection[str]) -> None:
        """Nothing can be wrong."""

    def select(
        self,
        names: Sequence[str],
        features: Sequence[Features],
        *,
        map_all: MapAll,
        rng: np.random.Generator,
    ) -> PairChoice:
        """All pairs."""
        return PairChoice(every_pair(len(names)), "all pairs")


@dataclass(frozen=True)
class SequenceWindow:
    """Each photograph with the ``window`` that follow it in the order of their names.

    ``loop`` : the last ones are followed by the first.
    """

    window: int = 5
    loop: bool = False

    def __post_init__(self) -> None:
        if self.window < 1:
            raise ValueError(
                f"a window of {self.window} gives no pairs; it is how many of the next photographs each is "
                "matched with, at least 1"
            )

    def check(self, names: Sequence[str], left_out: Collection[str]) -> None:
        """Nothing can be wrong."""

    def select(
        self,
        names: Sequence[str],
        features: Sequence[Features],
        *,
        map_all: MapAll,
        rng: np.random.Generator,
    ) -> PairChoice:
        """The pairs of the window; without features."""
        n = len(names)
        steps = range(1, min(self.window, n - 1) + 1)
        ends = n if self.loop else 0
        pairs = {tuple(sorted((i, (i + s) % n))) for i in range(n) for s in steps if i + s < n + ends}
        what = "the next photograph" if self.window == 1 else f"the next {self.window} photographs"
        around = ", the first again after the last" if self.loop else ""
        return PairChoice(pair_array(pairs), f"each with {what} in the order of their names{around}")


@dataclass(frozen=True)
class ListedPairs:
    """The pairs of file names that the user lists, in any order.

    A photograph that was left out (unreadable, a copy) takes its pairs with it; one that is not there is
    refused, as are a photograph paired with itself and a pair listed twice.
    """

    listed: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        seen: set[frozenset[str]] = set()
        for one, two in self.listed:
            if one == two:
                raise ValueError(f"the list pairs {one!r} with itself; a pair is two photographs")
            if (pair := frozenset((one, two))) in seen:
                raise ValueError(f"the list names the pair {one!r}, {two!r} twice; each pair stands once")
            seen.add(pair)

    def check(self, names: Sequence[str], left_out: Collection[str]) -> None:
        """Raise :class:`UsageError` for a name that is no photograph, and a list that leaves no pair."""
        known = {*names, *left_out}
        strange = sorted({name for pair in self.listed for name in pair} - known)
        if strange:
            more = f" and {len(strange) - 1} more" if len(strange) > 1 else ""
            some = ", ".join(repr(name) for name in sorted(known)[:3])
            raise UsageError(
                f"the list of pairs names {strange[0]!r}{more}, which is none of the {len(known)} "
                f"photographs ({some}{', ...' if len(known) > 3 else ''})"
            )
        if not any(set(pair) <= set(names) for pair in self.listed):
            without = "; its photographs were left out" if self.listed else ""
            raise UsageError(f"the list of pairs leaves no pair to match{without}")

    def select(
        self,
        names: Sequence[str],
        features: Sequence[Features],
        *,
        map_all: MapAll,
        rng: np.random.Generator,
    ) -> PairChoice:
        """The listed pairs whose photographs are both there; without features."""
        number = {name: i for i, name in enumerate(names)}
        there = (pair for pair in self.listed if pair[0] in number and pair[1] in number)
        return PairChoice(pair_array((number[one], number[two]) for one, two in there), "the listed pairs")
