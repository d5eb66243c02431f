"""Subsets of a scene: "NAME#k/n" is the k-th of n windows, spread over it."""

from __future__ import annotations

import math

from thesisrecon.errors import UsageError

SHARE = 2 / 3
"""Enough images for self-calibration where the scene has eight; neighbours by name mostly overlap."""


def window_names(scene: str, count: int) -> list[str]:
    return [f"{scene}#{k}/{count}" for k in range(1, count + 1)]


def window_parts(scene: str) -> tuple[str, int, int]:
    """Name of the scene, and number k of n windows; 0 of 0 for the whole scene."""
    name, mark, place = scene.rpartition("#")
    k, _, n = place.partition("/")
    if not mark or not (k.isdecimal() and n.isdecimal()):
        return scene, 0, 0
    if not 1 <= int(k) <= int(n):
        raise UsageError(f"a subset is NAME#k/n with k from 1 to n; got {scene!r}")
    return name, int(k), int(n)


def window_slice(scene: str, length: int) -> slice:
    """``SHARE`` of ``length`` images or rows; all of them for a whole scene."""
    _, k, n = window_parts(scene)
    if not n:
        return slice(0, length)
    size = math.ceil(SHARE * length)
    first = round((k - 1) * (length - size) / max(n - 1, 1))
    return slice(first, first + size)
