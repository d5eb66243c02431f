"""What the user lets the pipeline assume of the cameras: the wish in words, and as the stages take it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import UsageError, counted
from thesisrecon.records import INTRINSICS, Assumptions, Reconstruction

Mode = Literal["known", "constant", "free"]
"""``known``: has the given value; ``constant``: one unknown value per camera; ``free``: another in every
photograph."""

FARTHEST_CENTRE = 1.0
"""No principal point lies farther outside of its picture than this many long sides: a crop has its own, but
of a picture that far off the axis nothing would be left sharp."""
_DEVIATIONS = {
    "focal_std_rel": "focal",
    "aspect_std": "aspect",
    "skew_std_px": "skew",
    "principal_point_std_rel": "principal_point",
    "k1_std": "k1",
}
"""The setting of each standard deviation, and that of the mode it belongs to."""


@dataclass(frozen=True)
class IntrinsicsAssumption:
    """What is assumed of the intrinsics. By default nothing of the focal length; square pixels without skew;
    a principal point within about a hundredth of the long side of the image's middle; a moderate radial
    distortion.

    Every intrinsic has a mode (:data:`Mode`), a value and, where it is not known exactly, the value's
    standard deviation; ``none`` for the deviation: the value is only a place to start.

    Parameters
    ----------
    cameras : "shared": all photographs of one size come from one camera; "per-image": each has its own, and
        what is constant in a camera varies from photograph to photograph.
    alike : photographs of one size come from cameras of one kind: where they do not share a value, their
        values are taken to scatter about a common one. How much they scatter is measured.
    focal, focal_px, focal_std_rel : the focal length in pixels of the original photographs and its relative
        standard deviation, which must be given with it (unless the mode is known).
    exif : take the focal length of the EXIF header (35 mm equivalent) where there is one and ``focal_px`` is
        not given. Where a known focal is to come from a header that is silent, it is constant instead.
    aspect, aspect_ratio, aspect_std : height over width of a pixel, fy / fx.
    skew, skew_px, skew_std_px : in pixels of the original photographs.
    principal_point, principal_point_px, principal_point_std_rel : in pixels of the original photographs
        (None: the middle of the image); the deviation is a share of the long side.
    k1, k1_value, k1_std : radial distortion, a pure number.
    """

    cameras: Literal["shared", "per-image"] = "shared"
    alike: bool = True
    focal: Mode = "constant"
    focal_px: float | None = None
    focal_std_rel: float | None = None
    exif: bool = False
    aspect: Mode = "known"
    aspect_ratio: float = 1.0
    aspect_std: float | None = None
    skew: Mode = "known"
    skew_px: float = 0.0
    skew_std_px: float | None = None
    principal_point: Mode = "constant"
    principal_point_px: tuple[float, float] | None = None
    principal_point_std_rel: float | None = 0.01
    k1: Mode = "constant"
    k1_value: float = 0.0
    k1_std: float | None = 0.05

    def __post_init__(self) -> None:
        wanted = self.exif or self.focal_px is not None
        if wanted and self.focal != "known" and self.focal_std_rel is None:
            raise ValueError(
                "a focal prior needs its weight: set focal_std_rel (0.1 means 'within about 10 %')"
            )
        if self.focal == "known" and not wanted:
            raise ValueError("a known focal needs its value: set focal_px, or exif = true")
        for name in ("focal_px", "aspect_ratio"):
            value = getattr(self, name)
            if value is not None and not (value > 0 and math.isfinite(value)):
                raise ValueError(f"{name} must be above 0; got {value}")
        for name in ("skew_px", "k1_value"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be a number; got {getattr(self, name)}")
        if not all(math.isfinite(value) for value in self.principal_point_px or ()):
            raise ValueError(f"principal_point_px must be two numbers; got {self.principal_point_px}")
        self._check_deviations(wanted)

    def _check_deviations(self, focal_wanted: bool) -> None:
        """Refuse deviations that are no number, and those that would say nothing."""
        for name, intrinsic in _DEVIATIONS.items():
            value = getattr(self, name)
            if value is None:
                continue
            if not value > 0:
                raise ValueError(
                    f"{name} must be above 0; got {value} (what is known exactly has the mode known)"
                )
            if math.isinf(value):
                raise ValueError(f"{name} must be finite; got {value} (none means that nothing is known)")
            # A default that the mode makes idle was not asked for by anybody.
            if getattr(self, intrinsic) == "known" and value != type(self).__dataclass_fields__[name].default:
                raise ValueError(f"{name} = {value} says nothing where {intrinsic} is known: leave one out")
        if self.focal_std_rel is not None and not focal_wanted:
            raise ValueError(
                f"focal_std_rel = {self.focal_std_rel} says nothing without a focal length: set focal_px, or "
                "exif = true"
            )

    @property
    def modes(self) -> tuple[Mode, ...]:
        """The mode of each of :data:`INTRINSICS`."""
        return self.focal, self.aspect, self.skew, self.principal_point, self.principal_point, self.k1


def camera_groups(original_sizes: Sequence[tuple[int, int]], cameras: str) -> I64:
    """(V,) camera numbers: one per distinct size of the originals ("shared"), or one per image
    ("per-image").
    """
    if cameras == "per-image":
        return np.arange(len(original_sizes), dtype=np.int64)
    distinct = list(dict.fromkeys(original_sizes))
    return np.array([distinct.index(size) for size in original_sizes], dtype=np.int64)


def camera_numbers(
    original_sizes: Sequence[tuple[int, int]], wish: IntrinsicsAssumption, exif_focal_px: F64 | None = None
) -> I64:
    """(V,) numbers of the cameras, 0-based in the order of the views: views of one number agree in all
    intrinsics, by being tied or by being known to be the same.

    exif_focal_px (V,) as for :func:`assumptions_of_views`; None where no header is there.
    """
    n = len(original_sizes)
    exif = np.full(n, np.nan) if exif_focal_px is None else exif_focal_px
    assumed = assumptions_of_views(wish, original_sizes, exif, np.ones(n))
    known = assumed.std == 0.0
    tied = np.where(known, -1, assumed.shared).tolist()
    values = np.where(known, assumed.mean, 0.0).tolist()
    group = camera_groups(original_sizes, wish.cameras).tolist()
    keys = [(g, *t, *v) for g, t, v in zip(group, tied, values, strict=True)]
    distinct = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    return np.array([distinct[key] for key in keys], dtype=np.int64)


def assumptions_of_views(
    wish: IntrinsicsAssumption, original_sizes: Sequence[tuple[int, int]], exif_focal_px: F64, scales: F64
) -> Assumptions:
    """The wish as the stages take it, in pixels at working size.

    original_sizes: V pairs (width, height); exif_focal_px (V,) original px, NaN = not said; scales (V,)
    working over original size. Raises :class:`UsageError` for a principal point far outside of a picture.
    """
    n = len(original_sizes)
    check_sizes(wish, original_sizes)
    group, own = camera_groups(original_sizes, wish.cameras), np.arange(n, dtype=np.int64)
    # A known value is known for every view by itself: nothing is gained by tying it.
    shared = np.stack([group if mode == "constant" else own for mode in wish.modes], axis=1)
    alike = camera_groups(original_sizes, "shared") if wish.alike else own
    mean, std = _values(wish, np.array(original_sizes, dtype=np.float64).reshape(n, 2), exif_focal_px)
    for column, name in enumerate(INTRINSICS):
        if wish.modes[column] == "known":
            std[:, column] = 0.0
        if name in ("principal_x", "principal_y"):
            # Pixel (0, 0) is the centre of the first one: half a pixel stays where it is.
            mean[:, column] = (mean[:, column] + 0.5) * scales - 0.5
        elif name in ("focal", "skew"):
            mean[:, column] *= scales
        if name in ("skew", "principal_x", "principal_y"):
            std[:, column] *= scales
    silent = ~np.isfinite(mean[:, 0])
    std[silent, 0] = np.inf
    if wish.focal == "known":
        # What its header was to say and does not is constant: one number for the silent views of a camera.
        first = {g: i for i, g in reversed(list(enumerate(group.tolist()))) if silent[i]}
        shared[silent, 0] = [first[g] for g in group[silent].tolist()]
    return Assumptions(shared, mean, std, alike)


def check_sizes(wish: IntrinsicsAssumption, original_sizes: Sequence[tuple[int, int]]) -> None:
    """:class:`UsageError` where the principal point that is given lies far outside of a picture."""
    if wish.principal_point_px is None:
        return
    x, y = wish.principal_point_px
    for width, height in dict.fromkeys(original_sizes):
        outside = max(-x, x - width, -y, y - height)
        if outside > FARTHEST_CENTRE * max(width, height):
            raise UsageError(
                f"principal_point_px = ({x:g}, {y:g}) is {outside:.0f} px outside of a picture of "
                f"{width} x {height} px, more than its long side: it is meant in pixels of the original "
                "photographs"
            )


def assume(reconstruction: Reconstruction, wish: IntrinsicsAssumption | None = None) -> Assumptions:
    """The wish (the default where None) for a reconstruction, which knows one size and no header: all that is
    in pixels is meant in its own."""
    sizes = [(int(width), int(height)) for width, height in reconstruction.sizes]
    silent, same = np.full(len(sizes), np.nan), np.ones(len(sizes))
    return assumptions_of_views(wish or IntrinsicsAssumption(), sizes, silent, same)


def _values(wish: IntrinsicsAssumption, sizes: F64, exif_focal_px: F64) -> tuple[F64, F64]:
    """Means and standard deviations (V, 6) in original pixels; the modes are not yet looked at."""
    n = len(sizes)
    focal = np.full(n, np.nan)
    if wish.focal_px is not None:
        focal[:] = wish.focal_px
    elif wish.exif:
        focal = exif_focal_px.astype(np.float64)
    centre = (
        (sizes - 1.0) / 2.0 if wish.principal_point_px is None else np.tile(wish.principal_point_px, (n, 1))
    )
    one = np.ones(n)
    mean = np.column_stack([focal, wish.aspect_ratio * one, wish.skew_px * one, centre, wish.k1_value * one])
    deviations = (
        wish.focal_std_rel, wish.aspect_std, wish.skew_std_px, wish.principal_point_std_rel,
        wish.principal_point_std_rel, wish.k1_std,
    )  # fmt: skip
    std = np.tile([np.inf if value is None else value for value in deviations], (n, 1))
    std[:, 3:5] *= sizes.max(axis=1, keepdims=True)
    return mean, std


def prior_warnings(wish: IntrinsicsAssumption, exif_focal_px: F64) -> list[str]:
    """What the user must hear of a wish for EXIF focal lengths (V,) that the photographs cannot grant."""
    if not wish.exif or wish.focal_px is not None or not len(exif_focal_px):
        return []
    silent, total = int((~np.isfinite(exif_focal_px)).sum()), len(exif_focal_px)
    if not silent:
        return []
    # A focal that was to be known is estimated instead: that is another wish, and must be said.
    instead = ", so it is not known: it is taken to be one value per camera (constant), and estimated"
    rest = instead if wish.focal == "known" else ""
    if silent == total:
        none = f"none of the {counted(total, 'photograph')} names its focal length"
        return [f"{none}{rest or '; no prior was used'}"]
    name = "names" if silent == 1 else "name"
    return [f"{silent} of the {total} photographs {name} no focal length{rest or ' and have no prior'}"]
