"""Prior knowledge of the intrinsics: the user's :class:`IntrinsicsOptions` give one :class:`IntrinsicsPrior`.

Self-calibration and bundle adjustment derive their unknowns from the prior.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any, Literal

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import Notice, UsageError
from thesisrecon.records import IntrinsicsPrior, Reconstruction

Mode = Literal["known", "constant", "free"]
"""``known``: the value is given; ``constant``: one unknown value per camera; ``free``: one per image."""

LensModel = Literal["auto", "radial", "brown", "division", "fisheye"]

_OF_COLUMN = ("focal", "aspect", "skew", "principal_point", "principal_point", "k1")
"""Mode setting of each column."""
_STD_SETTINGS = {
    "focal_std_rel": "focal", "aspect_std": "aspect", "skew_std_px": "skew",
    "principal_point_std_rel": "principal_point", "k1_std": "k1",
}  # fmt: skip
"""Setting of each standard deviation -> its intrinsic."""


@dataclass(frozen=True)
class IntrinsicsOptions:
    """Prior knowledge of the cameras as the user sets it.

    Each intrinsic has a mode (:data:`Mode`), a value and, unless it is known, the standard deviation of the
    value (None: the value is only a starting value). The defaults: unknown focal length, square pixels, no
    skew, a principal point within about 1 % of the long side of the image centre, moderate radial distortion.
    ``ValueError`` if a value is not finite or out of range, or two settings contradict each other.
    """

    #: "shared": images of the same size and folder come from one camera; "per-size": images of the same size
    #: do, whatever their folder; "per-image": each image has its own camera
    cameras: Literal["shared", "per-size", "per-image"] = "shared"
    #: images of the same size come from cameras of the same kind: values that are not shared scatter about a
    #: common mean (hierarchical prior; the scatter is estimated)
    common_prior: bool = True
    focal: Mode = "constant"  #: focal length
    focal_px: float | None = None  #: in pixels of the original images
    focal_std_rel: float | None = None  #: standard deviation of the focal length, relative
    #: read it from EXIF (35 mm equivalent) if ``focal_px`` is not given; a known focal length that is missing
    #: there is estimated as constant
    exif: bool = False
    aspect: Mode = "known"  #: pixel height over width, fy / fx
    aspect_ratio: float = 1.0  #: value of the aspect
    aspect_std: float | None = None  #: standard deviation of the aspect
    skew: Mode = "known"  #: angle between the pixel axes
    skew_px: float = 0.0  #: in pixels of the original images
    skew_std_px: float | None = None  #: standard deviation of the skew
    principal_point: Mode = "constant"  #: image of the optical axis
    principal_point_px: tuple[float, float] | None = None  #: in pixels of the originals; None: image centre
    principal_point_std_rel: float | None = 0.01  #: its standard deviation over the long side
    k1: Mode = "constant"  #: first radial distortion coefficient
    k1_value: float = 0.0  #: value of k1
    k1_std: float | None = 0.05  #: standard deviation of k1
    #: model of the lens as of :class:`thesisrecon.Camera`; "auto": radial, and the model that explains the
    #: observations best where pairs of images show that lines bend much
    lens: LensModel = "auto"

    def __post_init__(self) -> None:
        given = self.exif or self.focal_px is not None
        if given and self.focal != "known" and self.focal_std_rel is None:
            raise ValueError("a focal prior needs focal_std_rel (0.1 means 'within about 10 %')")
        if self.focal == "known" and not given:
            raise ValueError("a known focal needs its value: set focal_px, or exif = true")
        for name in ("focal_px", "aspect_ratio"):
            value = getattr(self, name)
            if value is not None and not (value > 0 and math.isfinite(value)):
                raise ValueError(f"{name} must be above 0; got {value}")
        for name in ("skew_px", "k1_value", "principal_point_px"):
            value = getattr(self, name)
            if value is not None and not np.isfinite(value).all():
                raise ValueError(f"{name} must be finite; got {value}")
        if self.k1 == "known" and self.lens not in ("auto", "radial"):
            raise ValueError(f"k1 = known fixes a radial lens: leave out lens = {self.lens}, or k1")
        self._check_stds(given)

    def _check_stds(self, focal_given: bool) -> None:
        """Raise ``ValueError`` for standard deviations that are not positive or have no effect."""
        for name, intrinsic in _STD_SETTINGS.items():
            value = getattr(self, name)
            if value is None:
                continue
            if not value > 0:
                raise ValueError(f"{name} must be above 0; got {value} (for an exact value use mode known)")
            if math.isinf(value):
                raise ValueError(f"{name} must be finite; got {value} (none means unknown)")
            # A default value was not set by the user, so it is no error if it has no effect.
            if getattr(self, intrinsic) == "known" and value != type(self).__dataclass_fields__[name].default:
                raise ValueError(f"{name} = {value} has no effect with {intrinsic} = known: leave one out")
        if self.focal_std_rel is not None and not focal_given:
            raise ValueError(Notice("idle-focal-std", self.focal_std_rel))


def _numbered(keys: Sequence[tuple[Any, ...]], *, each: bool = False) -> I64:
    """Number (V,) of each key among the distinct ones, in order of appearance; ``each``: all are distinct."""
    if each:
        return np.arange(len(keys), dtype=np.int64)
    distinct = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    return np.array([distinct[key] for key in keys], dtype=np.int64)


def _cameras_of(options: IntrinsicsOptions, sizes: Sequence[tuple[int, int]], names: Sequence[str]) -> I64:
    """Number (V,) of the camera of each image by the options; without ``names`` there are no folders."""
    keys: list[tuple[Any, ...]] = list(sizes)
    if options.cameras == "shared" and names:
        keys = [(*size, PurePath(name).parent) for size, name in zip(sizes, names, strict=True)]
    return _numbered(keys, each=options.cameras == "per-image")


def camera_numbers(
    original_sizes: Sequence[tuple[int, int]], options: IntrinsicsOptions, exif_focal_px: F64 | None = None,
    names: Sequence[str] = (),
) -> I64:  # fmt: skip
    """Number the cameras (V,) so that views with equal numbers agree in all intrinsics, known or shared."""
    n = len(original_sizes)
    exif = np.full(n, np.nan) if exif_focal_px is None else exif_focal_px
    prior = prior_from_options(options, original_sizes, exif, np.ones(n), names)
    known = prior.std == 0.0
    tied, values = np.where(known, -1, prior.shared), np.where(known, prior.mean, 0.0)
    group = _cameras_of(options, original_sizes, names)
    return _numbered(list(map(tuple, np.column_stack([group, tied, values]).tolist())))


def prior_from_options(
    options: IntrinsicsOptions, original_sizes: Sequence[tuple[int, int]], exif_focal_px: F64, scales: F64,
    names: Sequence[str] = (),
) -> IntrinsicsPrior:  # fmt: skip
    """Return the prior of V views in pixels at working size; EXIF focals (V,) px or NaN, scales (V,).

    The ``names`` of the images tell their folders.
    """
    n = len(original_sizes)
    for width, height in dict.fromkeys(original_sizes):
        x, y = options.principal_point_px or (0.0, 0.0)
        outside = max(-x, x - width, -y, y - height)
        if outside > max(width, height):
            raise UsageError(Notice("far-principal-point", x, y, outside, width, height))
    group, own = _cameras_of(options, original_sizes, names), np.arange(n)
    # A known value is known for every view: sharing it would add nothing.
    modes = [getattr(options, name) for name in _OF_COLUMN]
    shared = np.stack([group if mode == "constant" else own for mode in modes], axis=1)
    kind = _numbered(original_sizes, each=not options.common_prior)
    mean, std = _values(options, np.array(original_sizes, dtype=np.float64).reshape(n, 2), exif_focal_px)
    std[:, [mode == "known" for mode in modes]] = 0.0
    # Columns of INTRINSICS. (0, 0) is the centre of the first pixel: x goes to (x + 0.5) s - 0.5.
    mean[:, [0, 2]] *= scales[:, None]
    mean[:, 3:5] = (mean[:, 3:5] + 0.5) * scales[:, None] - 0.5
    std[:, 2:5] *= scales[:, None]
    missing = ~np.isfinite(mean[:, 0])
    std[missing, 0] = np.inf
    if options.focal == "known":
        # A known focal that is missing in EXIF becomes constant: these views of a camera share one unknown.
        first = {g: i for i, g in reversed(list(enumerate(group.tolist()))) if missing[i]}
        shared[missing, 0] = [first[g] for g in group[missing].tolist()]
    return IntrinsicsPrior(mean, std, shared, kind, lens_model=options.lens)


def prior_for(reconstruction: Reconstruction, options: IntrinsicsOptions | None = None) -> IntrinsicsPrior:
    """Return the prior of the views of a reconstruction, in its own pixels and without EXIF."""
    sizes = [(int(width), int(height)) for width, height in reconstruction.sizes]
    missing, same = np.full(len(sizes), np.nan), np.ones(len(sizes))
    return prior_from_options(options or IntrinsicsOptions(), sizes, missing, same)


def _values(options: IntrinsicsOptions, sizes: F64, exif_focal_px: F64) -> tuple[F64, F64]:
    """Means and standard deviations (V, 6) in original pixels, modes ignored."""
    n, one, given = len(sizes), np.ones(len(sizes)), options.principal_point_px
    missing = exif_focal_px.astype(np.float64) if options.exif else np.nan * one
    focal = missing if options.focal_px is None else options.focal_px * one
    centre = (sizes - 1.0) / 2.0 if given is None else np.tile(given, (n, 1))
    aspect, skew, k1 = (value * one for value in (options.aspect_ratio, options.skew_px, options.k1_value))
    mean = np.column_stack([focal, aspect, skew, centre, k1])
    stds = {intrinsic: getattr(options, name) for name, intrinsic in _STD_SETTINGS.items()}
    std = np.tile([np.inf if stds[name] is None else stds[name] for name in _OF_COLUMN], (n, 1))
    std[:, 3:5] *= sizes.max(axis=1, keepdims=True)
    return mean, std
