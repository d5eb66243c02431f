"""The records that stages take and return, from images to the result of a run."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from thesisrecon import arrays
from thesisrecon.arrays import B8, F32, F64, I64, Record, Stratum
from thesisrecon.errors import Notice, counted


@dataclass(frozen=True, eq=False)
class Image(Record):
    """One image at working size; grey images and levels of other kinds become (H, W, 3) uint8.

    Examples
    --------
    >>> Image("a.png", np.zeros((480, 640, 3), np.uint8), (1280, 960)).size
    (640, 480)
    """

    name: str  #: file name
    rgb: NDArray[np.uint8]  #: (H, W, 3)
    original_size: tuple[int, int]  #: (width, height) after EXIF rotation (from COLMAP: as stored)
    mask: B8 | None = None  #: (H, W) pixels to use; None: all

    def __post_init__(self) -> None:
        rgb, known = self.rgb, None
        if not (isinstance(rgb, np.ndarray) and rgb.dtype == np.uint8 and rgb.shape[2:] == (3,)):
            rgb, known = arrays.eight_bit(arrays.image_levels(self.rgb)[0])
            if rgb.ndim > 1 and rgb.size == np.prod(rgb.shape[:2]):
                rgb = np.repeat(rgb.reshape(*rgb.shape[:2], 1), 3, axis=2)
            if rgb.ndim != 3 or rgb.shape[2] != 3:
                raise ValueError(f"an Image needs rgb (H, W, 3); got {np.shape(self.rgb)}")
            object.__setattr__(self, "rgb", rgb)
        if self.mask is not None:
            plain = type(self.mask) is np.ndarray and self.mask.dtype == bool
            mask = self.mask if plain else arrays.numbers("an Image", mask=self.mask)[0] != 0.0
            arrays.require_shapes("an Image", rgb=(rgb, ("H", "W", 3)), mask=(mask, ("H", "W")))
            known = mask if known is None else known & mask
        if known is not None:
            object.__setattr__(self, "mask", known)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) at working size."""
        return self.rgb.shape[1], self.rgb.shape[0]

    @property
    def scale(self) -> float:
        """Working pixels per original pixel along x and y: ``xy = (xy_original + 0.5) scale - 0.5``."""
        return max(self.size) / max(self.original_size)

    @property
    def original_from_working(self) -> F64:
        """Transform of homogeneous pixels (3, 3), (x + 0.5) / scale - 0.5."""
        return arrays.resizing_transform(1 / self.scale)

    @property
    def gray(self) -> F32:
        """(H, W) float32 luminance, 0 to 255 (ITU-R BT.601 weights)."""
        weights = np.array([0.299, 0.587, 0.114], dtype=np.float32)
        return np.ascontiguousarray(self.rgb.astype(np.float32) @ weights)

    @property
    def levels(self) -> F32:
        """(H, W, 3) float32, NaN in masked pixels."""
        levels = self.rgb.astype(np.float32)
        if self.mask is not None:
            levels[~self.mask] = np.nan
        return levels


@dataclass(frozen=True, eq=False)
class Seeds(Record):
    """Corners of several scales with a normalised patch each, matched without a search radius."""

    xy: F64  #: (S, 2) positions, px
    scale: F32  #: (S,) pixels per sample of the pyramid level
    angle: F32  #: (S,) rotation of the patch, rad; 0 = upright
    patches: F32  #: (S, D) cosine coefficients of each patch, without the mean, unit norm
    frame: F64 | None = None  #: (S, 2, 2) px per sample along the patch's axes; None: by scale and angle


@dataclass(frozen=True, eq=False)
class Features(Record):
    """Corners of one image, strongest first."""

    xy: F64  #: (N, 2) positions, px
    scale: F32  #: (N,) scale of each corner
    response: F32  #: (N,) corner response
    seeds: Seeds | None = None
    oblique: Seeds | None = None  #: seeds of simulated oblique views, for pairs that need them


@dataclass(frozen=True, eq=False)
class Matches(Record):
    """Matched corners of views i and j."""

    i: int
    j: int
    index1: I64  #: (M,) indices into ``Features.xy`` of view i, each corner at most once
    index2: I64  #: the same of view j
    xy1: F64  #: (M, 2) positions after sub-pixel alignment, px
    xy2: F64
    score: F32  #: (M,) correlation in [-1, 1]
    affine: F64  #: (M, 2, 2) local map from image 1 to image 2; identity if it was not estimated


@dataclass(frozen=True, eq=False)
class PairChoice(Record):
    """The pairs of views to match."""

    pairs: I64  #: (M, 2) view numbers, the smaller first, sorted
    how: str  #: how the pairs were selected
    compared: int = 0  #: number of pairs whose overlap was estimated


@dataclass(frozen=True, eq=False)
class DegeneracyReport(Record):
    """Whether the matches of a pair determine its F (no other F explains them as well), with the evidence."""

    determined: bool
    reasons: tuple[str, ...] = ()  #: why F is undetermined
    off_plane: float = 0.0  #: inliers off the dominant plane; matches at one position count once
    contradicted: float = 0.0  #: the part of them that neighbours on the plane contradict
    log10_false_alarms: float = 0.0  #: log10 of the expected number of chance models with as many
    competing_margin: float = float("inf")  #: standard errors by which F explains more than the other F
    competing_model: F64 | None = None  #: best other F (3, 3) that differs at a relevant distance
    expected_error_px: float = float("inf")  #: RMS epipolar distance of exact matches by the covariance of F


@dataclass(frozen=True, eq=False)
class FundamentalFit(Record):
    """A robust estimate of F."""

    F: F64  #: (3, 3) of unit Frobenius norm
    inliers: B8  #: (M,)
    sigma_px: float  #: standard deviation of one image coordinate, estimated from the inliers
    #: (9, 9) of the entries of F, row by row, by noise alone: a wrong match near its line is not in it
    covariance: F64
    iterations: int = 0  #: number of samples
    #: (K, 3, 3) other results of the search, best first; F is ambiguous if they explain as many matches
    competing_models: F64 = field(default_factory=lambda: np.empty((0, 3, 3)))


@dataclass(frozen=True, eq=False)
class TwoView(Record):
    """A pair of views with its epipolar geometry and its verified matches, which are valid for any F."""

    i: int
    j: int
    F: F64  #: (3, 3) of unit Frobenius norm
    sigma_px: float  #: standard deviation of one image coordinate
    index1: I64  #: verified matches, as in :class:`Matches`
    index2: I64
    xy1: F64
    xy2: F64
    affine: F64
    candidates: int  #: number of matches before verification
    #: fraction of the verified matches that one homography explains; near 1 for a plane or a pure rotation
    homography_inlier_ratio: float
    accepted: bool  #: whether the pair enters the tracks
    reason: str = ""  #: why it does not
    configuration: str = ""  #: "general", "plane", "pure rotation" or "pure translation"; "" if too few
    degeneracy: DegeneracyReport | None = None  #: None for too few matches

    @property
    def inliers(self) -> int:
        """Number of verified matches."""
        return len(self.xy1)

    @property
    def undetermined(self) -> bool:
        """Whether F was tested and other epipolar geometries explain the matches as well."""
        return self.degeneracy is not None and not self.degeneracy.determined


@dataclass(frozen=True, eq=False)
class Tracks(Record):
    """Observations of scene points, sorted by (point, view); a point at most once per view."""

    view_index: I64  #: (K,)
    point_index: I64  #: (K,)
    xy: F64  #: (K, 2) positions, px
    n_views: int
    n_points: int


def common_points(view: I64, point: I64, n_views: int) -> scipy.sparse.csr_array:
    """Number of points that each two views observe (V, V), sparse."""
    size = (n_views, int(point.max(initial=0)) + 1)
    seen = scipy.sparse.csr_array((np.ones(len(view)), (view, point)), size)
    return seen @ seen.T


@dataclass(frozen=True, eq=False)
class Reconstruction(Record):
    """Cameras and points in one stratum ("projective", "affine" or "metric"), with their tracks."""

    stratum: Stratum
    P: F64  #: (V, 3, 4), zeros where not registered; K [R t] before distortion in the metric stratum
    X: F64  #: (N, 4), zeros where not valid; last coordinate 1 in the metric stratum
    registered: B8  #: (V,)
    valid: B8  #: (N,) reconstructed points
    inlier: B8  #: (K,) inliers among the observations in ``tracks``
    tracks: Tracks
    sizes: I64  #: (V, 2) width and height
    sigma_px: float  #: noise of one image coordinate
    reasons: tuple[str, ...]  #: per view why it is not registered; empty where it is
    K: F64 | None = None  #: (V, 3, 3) calibration matrices in the metric stratum
    distortion: F64 | None = None  #: (V, C) rows as :attr:`thesisrecon.Camera.lens_row`; None: none

    @property
    def used(self) -> B8:
        """(K,) inliers among the observations of valid points in registered views."""
        view, point = self.tracks.view_index, self.tracks.point_index
        return self.inlier & self.registered[view] & self.valid[point]

    @property
    def common_points(self) -> F64:
        """(V, V) number of points with an inlier in both views."""
        t, keep = self.tracks, self.inlier
        return np.asarray(common_points(t.view_index[keep], t.point_index[keep], t.n_views).toarray())


def with_reasons(found: Reconstruction, min_points: int) -> Reconstruction:
    """Give each unregistered view without a reason the number of points that it sees, of ``min_points``."""
    t, reasons = found.tracks, list(found.reasons)
    seen = np.bincount(t.view_index[found.valid[t.point_index]], minlength=t.n_views)
    for view in np.flatnonzero(~found.registered):
        few = Notice("few-common-points", counted(seen[view], "point"), min_points)
        reasons[view] = reasons[view] or (few if seen[view] else Notice("no-common-points"))
    return replace(found, reasons=tuple(reasons))


INTRINSICS = ("focal", "aspect", "skew", "principal_x", "principal_y", "k1")
"""Columns of every per-view table of intrinsics."""


@dataclass(frozen=True, eq=False)
class IntrinsicsPrior(Record):
    """Gaussian prior of the intrinsics of V views or cameras, in pixels at working size."""

    #: (V, C), C = 6 columns as in :data:`INTRINSICS`, or 8 with k2 and k3; NaN: a focal without initial value
    mean: F64
    #: (V, C), relative for the focal (the prior acts on log f); 0: known, does not move; inf: only initial
    std: F64
    shared: I64  #: (V, C) rows with equal numbers in a column share its value; unused in bundle adjustment
    kind: I64  #: (V,) rows with equal numbers are cameras of the same kind (the same lens model); -1: none
    #: (C,) or (V, C) hierarchical prior: standard deviation of a kind's values about their unknown mean (of
    #: its first row; relative for the focal; inf: no such prior); None: not yet estimated
    spread: F64 | None = None
    #: (V, 3) lenses in half diagonals found in pairs: k1, k2 and the base; None: straight but for k1
    lens: F64 | None = None
    lens_model: str = "auto"  #: as in ``IntrinsicsOptions.lens``

    @classmethod
    def unshared(
        cls, mean: F64, std: F64, *, kind: I64 | None = None, spread: F64 | None = None
    ) -> "IntrinsicsPrior":
        """Return a prior whose rows share no value; ``kind`` None: no kinds."""
        shared = np.repeat(np.arange(len(mean))[:, None], mean.shape[1], axis=1)
        return cls(mean, std, shared, np.full(len(mean), -1) if kind is None else kind, spread)

    @property
    def group(self) -> I64:
        """(V,) camera number of each view by its focal, 0-based and dense."""
        return np.unique(self.shared[:, 0], return_inverse=True)[1].astype(np.int64)

    @property
    def focal_known(self) -> B8:
        """(V,) whether a focal length is given, exactly or with a standard deviation."""
        return np.isfinite(self.std[:, 0]) & np.isfinite(self.mean[:, 0])


@dataclass(frozen=True, eq=False)
class Upgrade(Record):
    """One candidate of self-calibration."""

    metric_from_projective: F64  #: (4, 4)
    K: F64  #: (V, 3, 3) calibration matrices, zeros where not registered
    cost: float  #: value of the criterion
    method: str  #: the method it came from


@dataclass(frozen=True, eq=False)
class IdentifiabilityReport(Record):
    """Whether the views determine the calibration under the prior, and the nearest critical motion."""

    identifiable: bool  #: whether the calibration is determined; the prior may resolve a critical motion
    motion: str  #: nearest critical motion ("pure translation", "turntable", ...), empty if not measurable
    critical: bool  #: whether the cameras cannot be distinguished from that motion
    evidence: Mapping[str, float]
    sentences: tuple[str, ...] = ()  #: what was found, what it means and what to do
    undetermined: tuple[int, ...] = ()  #: views whose own focal length is not determined
    prior_contradicted: bool = False  #: determined but for the prior, such as one camera for zoomed images


@dataclass(frozen=True, eq=False)
class SelfCalibration(Record):
    """Result of self-calibration (chapter 7)."""

    metric_from_projective: F64  #: (4, 4) upgrading transform of the best candidate
    K: F64  #: (V, 3, 3) calibration matrices, zeros where not registered
    K_std: F64  #: (V, 3, 3) standard deviations; 0: known, that of the prior: not estimated, NaN: unknown
    identifiable: bool  #: whether the views determine the calibration
    #: why they do not, or that bundle adjustment moves the focal length far from ``K``, then an initial value
    reasons: tuple[str, ...]
    candidates: tuple[Upgrade, ...] = ()  #: all candidates, best first
    identifiability: IdentifiabilityReport | None = None  #: the evidence; None: not tested

    @property
    def Q(self) -> F64:
        """Absolute dual quadric in the projective frame (4, 4), rank 3, unit norm."""
        G = np.linalg.inv(self.metric_from_projective)[:, :3]
        return np.asarray(G @ G.T / np.linalg.norm(G @ G.T), dtype=np.float64)

    @property
    def plane_at_infinity(self) -> F64:
        """Plane at infinity in the projective frame (4,), unit norm."""
        plane = self.metric_from_projective[3]
        return np.asarray(plane / np.linalg.norm(plane), dtype=np.float64)


def calibration_of_metric(K: F64, method: str) -> SelfCalibration:
    """The calibration of cameras that are metric already: one candidate, the identity."""
    only = Upgrade(np.eye(4), K, 0.0, method)
    return SelfCalibration(np.eye(4), K, np.full_like(K, np.nan), True, (), (only,))


GIVEN = "given"
"""Source of the intrinsics of a camera that was known."""


@dataclass(frozen=True, eq=False)
class IntrinsicInterval(Record):
    """One intrinsic of one view with its standard deviation (in pixels or dimensionless) and source."""

    value: float
    std: float
    source: str


@dataclass(frozen=True, eq=False)
class MetricResult(Record):
    """Result of the metric stage."""

    reconstruction: Reconstruction
    #: per registered view "focal_px", "aspect" (fy / fx), "skew_px", "principal_x_px", "principal_y_px",
    #: "k1", "k2", "k3" (std 0: as assumed), of other lenses further "k4", "p1", "p2", and what they give:
    #: "angle_of_view_deg" along the long side and "corner_deg", that of the farthest corner from the axis
    intrinsics: tuple[Mapping[str, IntrinsicInterval], ...]
    self_check: Mapping[str, float]
    trusted: bool  #: whether the self-check passed
    failed_checks: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()  #: remarks on a trusted result, such as focals inferred from other cameras
    limitations: tuple[str, ...] = ()  #: differences between the images and the simplest camera model
    #: of the returned cameras and points; None: not tested
    identifiability: IdentifiabilityReport | None = None
    #: (V, 6) of the rotation about the axes of the camera, rad, and of the centre along those of the model,
    #: after the similarity that aligns the cameras best; NaN where unknown
    pose_std: F64 | None = None


@dataclass(frozen=True, eq=False)
class DisparityMap(Record):
    """Disparity of the left image of a rectified pair."""

    disparity: F32  #: (H, W) x_right = x_left - d, NaN where unknown or occluded
    confidence: F32  #: (H, W) in [0, 1], 0 where unknown
    sigma_px: float  #: standard deviation of a confident disparity

    def filled(self) -> F32:
        """Return the disparity (H, W) with holes filled by the farther neighbour of the row.

        Returns
        -------
        ndarray (H, W)
            Rows without any disparity stay NaN.
        """
        known = np.isfinite(self.disparity)
        columns = np.arange(self.disparity.shape[1])
        left = np.maximum.accumulate(np.where(known, columns, -1), axis=1)
        right = np.minimum.accumulate(np.where(known, columns, len(columns))[:, ::-1], axis=1)[:, ::-1]
        padded = np.pad(self.disparity, ((0, 0), (1, 1)), constant_values=np.nan)
        from_left, from_right = (np.take_along_axis(padded, i + 1, axis=1) for i in (left, right))
        return np.asarray(np.fmin(from_left, from_right))


@dataclass(frozen=True, eq=False)
class DepthMap(Record):
    """Depth map of one view, distortion removed."""

    view: int  #: number of the image, or of a ``PinholeView`` of it
    P: F64  #: K [R t] for the pixels of this map, which may be fewer than those of the image
    depth: F32  #: (H, W) z in the camera frame, NaN where unknown
    std: F32  #: (H, W)
    views: NDArray[np.uint8]  #: (H, W) number of other views that confirm it


@dataclass(frozen=True, eq=False)
class PinholeView(Record):
    """An image with its distortion removed, or a part of a wide one."""

    view: int  #: number of the image; of V images those at the sides of a wide one have it plus V to 4 V
    P: F64  #: K [R t]
    rgb: NDArray[np.uint8]  #: (H, W, 3)
    seen: B8  #: (H, W) pixels inside the original image and its mask


@dataclass(frozen=True, eq=False)
class TexturedMesh(Record):
    """A triangle mesh with vertex colours, a texture or neither.

    The calls also take faces of quads (M, 4), uv (M, 4, 2), and colours as floats from 0 to 1.
    """

    vertices: F64  #: (N, 3)
    faces: I64  #: (M, 3) vertex indices, counter-clockwise seen from outside
    colors: NDArray[np.uint8] | None = None  #: (N, 3)
    uv: F64 | None = None  #: (M, 3, 2) texels of the corners, (0, 0) = centre of the top-left texel
    texture: NDArray[np.uint8] | None = None  #: (H, W, 3)
    untextured: B8 | None = None  #: (M,) faces that no view sees

    def show(self, cameras: Any = (), height: int = 560) -> Any:
        """Return the 3D viewer of the report for a notebook: one page in a frame that needs no server.

        Parameters
        ----------
        cameras : mapping or sequence of Camera
            Viewpoints, by name or in a list.
        height : int
            Height of the frame (px).

        Returns
        -------
        ModelFrame
            Shown by a notebook; ``page`` is the HTML.
        """
        # The report is above the records, and notebooks load it.
        return import_module("thesisrecon.report._page").ModelFrame.of(self, cameras, height)


@dataclass(frozen=True, eq=False)
class RenderedView(Record):
    """A rendered mesh."""

    color: NDArray[np.uint8]  #: (H, W, 3)
    depth: F32  #: (H, W) z in the camera frame, NaN where empty
    valid: B8  #: (H, W) pixels with a surface


@dataclass(frozen=True, eq=False)
class HeldOut(Record):
    """Comparison of a held-out image, distortion removed, with the rendered model."""

    view: int
    real: NDArray[np.uint8]  #: (H, W, 3)
    rendered: NDArray[np.uint8]  #: (H, W, 3)
    compared: B8  #: (H, W) pixels that both cover
    psnr_db: float  #: peak signal-to-noise ratio
    ssim: float  #: structural similarity, 1 = identical

    @property
    def share(self) -> float:
        """Fraction of the pixels that were compared."""
        return float(self.compared.mean()) if self.compared.size else 0.0


@dataclass(frozen=True, eq=False)
class StageReport(Record):
    """Computing time, numbers and warnings of one stage."""

    stage: str
    seconds: float
    counts: Mapping[str, int] = field(default_factory=dict)
    metrics: Mapping[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


def as_mesh(caller: str, mesh: TexturedMesh) -> TexturedMesh:
    """Return a mesh of triangles in the types of the record.

    Quads become two triangles each; colours and textures of floats or 16 bits levels from 0 to 255.
    ``ValueError`` unless faces, colours and texture coordinates fit the vertices, finite where used.
    """
    if not isinstance(mesh, TexturedMesh):
        raise ValueError(Notice("no-mesh", caller, type(mesh).__name__))
    missing = ("vertices", "faces", "uv")
    vertices, corners = arrays.numbers(caller, missing=missing, vertices=mesh.vertices, faces=mesh.faces)
    n = len(vertices)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        advice = "; divide homogeneous ones by their last coordinate" if vertices.shape[1:] == (4,) else ""
        raise ValueError(f"{caller} needs vertices (N, 3) of the mesh; got {vertices.shape}{advice}")
    if corners.ndim != 2 or corners.shape[1] not in (3, 4):
        raise ValueError(Notice("shape-of-faces", caller, corners.shape))
    if not (corners == np.rint(corners)).all():
        raise ValueError(f"{caller} needs faces of whole numbers, the rows of their vertices; some are not")
    faces = corners.astype(np.int64)
    if len(faces) and not 0 <= faces.min() <= faces.max() < n:
        raise ValueError(f"{caller}: the faces refer to vertices that do not exist")
    if not np.isfinite(vertices[np.unique(faces)]).all():
        raise ValueError(f"{caller}: the vertices of faces must be finite")
    uv = None if mesh.uv is None else arrays.numbers(caller, missing=missing, uv=mesh.uv)[0]
    if uv is not None and uv.shape != (*faces.shape, 2):
        raise ValueError(f"{caller}: uv must be {(*faces.shape, 2)}; got {uv.shape}")
    if uv is not None and not np.isfinite(uv).all():
        raise ValueError(f"{caller}: uv must be finite")
    untextured = mesh.untextured
    if faces.shape[1] == 4:
        faces = _halves(faces)
        uv = None if uv is None else _halves(uv)
        untextured = None if untextured is None else np.repeat(untextured, 2)
    colors = None if mesh.colors is None else _colours(caller, "colors", mesh.colors, (n,))
    image = None if mesh.texture is None else _colours(caller, "texture", mesh.texture, ("H", "W"))
    return replace(
        mesh, vertices=vertices, faces=faces, colors=colors, uv=uv, texture=image, untextured=untextured
    )


def _halves(quads: NDArray[Any]) -> NDArray[Any]:
    """Two triangles (2 M, 3, ...) of each quad (M, 4, ...), in the order of their corners."""
    return np.asarray(quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, *quads.shape[2:]))


def _colours(caller: str, name: str, given: Any, shape: tuple[int | str, ...]) -> NDArray[np.uint8]:
    """Colours (..., 3) as uint8; those of (..., 4) lose their alpha."""
    (levels,) = arrays.image_levels(given)
    levels = levels[..., :3] if levels.shape[-1:] == (4,) else levels
    arrays.require_shapes(caller, **{name: (levels, (*shape, 3))})
    if not np.isfinite(levels).all():
        raise ValueError(f"{caller}: {name} must be finite")
    return np.ascontiguousarray(np.rint(np.clip(levels, 0.0, 255.0)), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class Similarity(Record):
    """The similarity y = scale R x + t, with a positive scale."""

    scale: float
    R: F64
    t: F64

    @classmethod
    def scaling(cls, scale: float) -> "Similarity":
        """Return the similarity x -> scale x."""
        return cls(scale, np.eye(3), np.zeros(3))

    def apply(self, X: F64) -> F64:
        """Transform points (N, 3)."""
        return np.asarray(self.scale * X @ self.R.T + self.t)

    @property
    def matrix(self) -> F64:
        """Transform of homogeneous points (4, 4)."""
        G = np.eye(4)
        G[:3, :3] = self.scale * self.R
        G[:3, 3] = self.t
        return G
