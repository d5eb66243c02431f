"""Values that are computed when they are used, in least-recently-used caches of a number of bytes."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, Generic, TypeVar, overload

Value = TypeVar("Value", covariant=True)
Key = TypeVar("Key", bound=Hashable)
Made = TypeVar("Made")


class RecentlyUsed(Generic[Key, Made]):
    """Values by key; the last used ones are kept within ``max_bytes``, at least ``least`` of them."""

    def __init__(self, max_bytes: float, least: int = 2) -> None:
        self._max_bytes, self._least = max_bytes, least
        self._kept: OrderedDict[Key, tuple[Made, int]] = OrderedDict()
        self._lock, self._bytes = threading.Lock(), 0

    def get(self, key: Key, make: Callable[[], Made]) -> Made:
        """Return the value of a key; ``make`` it if it is not kept."""
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key][0]
        # Two threads may both make a value: cheaper than one waiting for the other.
        made = make()
        with self._lock:
            if key not in self._kept:
                self._kept[key] = made, size_in_bytes(made)
                self._bytes += self._kept[key][1]
            while self._bytes > self._max_bytes and len(self._kept) > self._least:
                self._bytes -= self._kept.popitem(last=False)[1][1]
        return made


class OnDemand(Sequence[Value]):
    """A sequence of ``count`` items that ``make(number)`` gives, the same for a number each time.

    The last used items are kept within ``max_bytes``. A pickled sequence is a list of all items.
    """

    def __init__(self, count: int, make: Callable[[int], Value], max_bytes: float = 0.0) -> None:
        self._count, self._make = count, make
        self._kept: RecentlyUsed[int, Value] = RecentlyUsed(max_bytes, least=0)

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, number: int) -> Value: ...

    @overload
    def __getitem__(self, number: slice) -> "OnDemand[Value]": ...

    def __getitem__(self, number: int | slice) -> "Value | OnDemand[Value]":
        if isinstance(number, slice):
            some = range(self._count)[number]
            return OnDemand(len(some), lambda n: self[some[n]])
        place = range(self._count)[number]
        return self._kept.get(place, lambda: self._make(place))

    def keep(self, number: int, value: Value) -> None:  # type: ignore[misc]
        """Take an item that was made elsewhere."""
        self._kept.get(number, lambda: value)

    def __reduce__(self) -> tuple[type[list[Value]], tuple[list[Value]]]:
        return list, (list(self),)


class MappingOnDemand(Mapping[int, Value]):
    """A mapping from ``keys`` to items that ``make(key)`` gives, in memory like an :class:`OnDemand`."""

    def __init__(self, keys: Sequence[int], make: Callable[[int], Value], max_bytes: float = 0.0) -> None:
        self._place = {key: place for place, key in enumerate(keys)}
        self._items = OnDemand(len(keys), lambda place: make(keys[place]), max_bytes)

    def __len__(self) -> int:
        return len(self._place)

    def __iter__(self) -> Iterator[int]:
        return iter(self._place)

    def __contains__(self, key: object) -> bool:
        return key in self._place

    def __getitem__(self, key: int) -> Value:
        return self._items[self._place[key]]

    def __reduce__(self) -> tuple[type[dict[int, Value]], tuple[dict[int, Value]]]:
        return dict, (dict(self.items()),)


def size_in_bytes(value: Any) -> int:
    """Bytes of the arrays of a record."""
    if hasattr(value, "nbytes"):
        return int(value.nbytes)
    if is_dataclass(value):
        return sum(size_in_bytes(getattr(value, f.name)) for f in fields(value))
    return sum(size_in_bytes(part) for part in value) if isinstance(value, tuple) else 0
