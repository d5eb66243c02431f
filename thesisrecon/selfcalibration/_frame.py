"""Reference frame of chapter 7 (unit-free pixels, one camera at [I | 0]) and the unknowns of the solvers.

With H = [[K_r, 0], [-p' K_r, 1]], P H is metric if the plane at infinity p and K_r are right (HZ 19.2).
"""

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import pixel_from_unit
from thesisrecon.optimize.bundle.projection import calibrations
from thesisrecon.optimize.least_squares import central_differences
from thesisrecon.records import IntrinsicsPrior, Reconstruction

# Error of a unit-free infinite homography: the weight of linear constraints from approximate intrinsics.
HOMOGRAPHY_NOISE = 0.01

# log focal, log of (aspect / prior aspect), skew, principal point (x, y) minus the prior one; unit-free.
_N_INTRINSICS = 5
# No skew, square pixels, principal point near the image centre.
_SQUARE_PIXEL_STD = (0.0, HOMOGRAPHY_NOISE, HOMOGRAPHY_NOISE, 0.0)

_RANK_TOLERANCE = 1e-11  # relative size below which a singular value, or a distance of centres, is rounding

# Relative standard deviation of an exactly known focal length; keeps every criterion finite.
_KNOWN_FOCAL_STD = 1e-4


@dataclass(frozen=True)
class ReferenceFrame:
    """Registered cameras [A_i | a_i] up to scale, in unit-free pixels, the reference camera at [I | 0].

    ``views`` (R,) are view numbers, ``reference`` an index into ``views``; cameras of the same ``group`` (R,)
    share their focal length. ``pixel_from_unit`` (V, 3, 3) is that of all views. ``focal_mean`` and
    ``focal_std`` (G,) are the prior of the log focal lengths, NaN and inf where unknown.
    """

    A: F64
    a: F64
    views: I64
    reference: int
    group: I64
    pixel_from_unit: F64
    reference_from_projective: F64
    focal_mean: F64
    focal_std: F64
    prior: IntrinsicsPrior

    @property
    def P(self) -> F64:
        """Cameras (R, 3, 4)."""
        return np.concatenate([self.A, self.a[:, :, None]], axis=2)

    def homographies(self, planes: F64) -> F64:
        """Infinite homographies A_i - a_i p' (3.29) of planes (B, 3), up to scale (B, R, 3, 3)."""
        return np.asarray(self.A[None] - self.a[None, :, :, None] * planes[:, None, None, :])

    def group_medians(self, values: F64) -> F64:
        """Medians (..., G) over the cameras of each group of values (..., R)."""
        groups = range(int(self.group.max()) + 1)
        return np.stack([np.median(values[..., self.group == g], axis=-1) for g in groups], axis=-1)

    def subset(self, keep: I64) -> "ReferenceFrame":
        """Return the same frame with the cameras at some places, the reference among them."""
        kept, groups = np.unique(self.group[keep], return_inverse=True)
        return replace(
            self, A=self.A[keep], a=self.a[keep], views=self.views[keep], group=groups.astype(np.int64),
            reference=int(np.flatnonzero(keep == self.reference)[0]),
            focal_mean=self.focal_mean[kept], focal_std=self.focal_std[kept],
        )  # fmt: skip


def build_frame(reconstruction: Reconstruction, prior: IntrinsicsPrior, unit: F64) -> ReferenceFrame:
    """Transform the registered cameras to a reference frame with a median baseline of 1."""
    views = np.flatnonzero(reconstruction.registered)
    P = np.linalg.inv(unit[views]) @ reconstruction.P[views]
    require_cameras_of_full_rank(P)
    seen = reconstruction.tracks.view_index[reconstruction.inlier]
    place = int(np.bincount(seen, minlength=len(unit))[views].argmax())
    U, S, Vt = np.linalg.svd(P[place])
    projective_from_reference = np.column_stack([Vt[:3].T @ np.diag(1.0 / S) @ U.T, Vt[3]])
    Q = P @ projective_from_reference
    Q /= np.linalg.norm(Q[:, :, :3], axis=(1, 2))[:, None, None] / np.sqrt(3.0)
    others = np.delete(np.linalg.norm(Q[:, :, 3], axis=1), place)
    baseline = float(np.median(others)) if len(others) else 1.0
    projective_from_reference[:, 3] /= max(baseline, 1e-12)
    Q[:, :, 3] /= max(baseline, 1e-12)
    group = np.unique(prior.group[views], return_inverse=True)[1].astype(np.int64)
    back = np.linalg.inv(projective_from_reference)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_f = np.log(prior.mean[views, 0] / unit[views, 0, 0])
    mean, std = np.full(group.max() + 1, np.nan), np.full(group.max() + 1, np.inf)
    for g in range(len(mean)):
        mine = prior.focal_known[views] & (group == g)
        if mine.any():
            mean[g] = np.median(log_f[mine])
            std[g] = max(float(np.median(prior.std[views[mine], 0])), _KNOWN_FOCAL_STD)
    return ReferenceFrame(Q[:, :, :3], Q[:, :, 3], views, place, group, unit, back, mean, std, prior)


def require_cameras_of_full_rank(P: F64) -> None:
    """Raise ``StageFailure`` if a camera (R, 3, 4) has rank below 3 or all centres coincide."""
    size = np.linalg.norm(P, axis=(1, 2))
    if bad := int((~np.isfinite(P).all(axis=(1, 2)) | (size == 0.0)).sum()):
        evidence = f"{bad} of {len(P)} projective cameras are zero or not finite"
    else:
        S = np.linalg.svd(P / size[:, None, None], compute_uv=False)
        flat = int((S[:, 2] < _RANK_TOLERANCE * S[:, 0]).sum())
        centres = np.linalg.svd(P)[2][:, 3]
        apart = float(np.sqrt(np.maximum(1.0 - (centres @ centres[0]) ** 2, 0.0)).max())
        if not flat and apart > _RANK_TOLERANCE:
            return
        evidence = f"the camera centres are {apart:.1e} apart"
        if flat:
            evidence = f"{flat} of {len(P)} projective cameras have rank below 3"
    raise cannot_be_calibrated(evidence)


def cannot_be_calibrated(evidence: str) -> StageFailure:
    return StageFailure.of("cameras-without-calibration", evidence)


def normalized_frame(reconstruction: Reconstruction, prior: IntrinsicsPrior) -> ReferenceFrame:
    """Return a frame that absorbs the prior aspect and principal point: K = diag(f, f, 1) if they hold."""
    n = int(reconstruction.registered.sum())
    if n < 3:
        raise StageFailure.of("few-views-to-calibrate", n)
    unit = pixel_from_unit(reconstruction.sizes)
    unit[:, 1, 1] *= prior.mean[:, 1]
    unit[:, :2, 2] = prior.mean[:, 3:5]
    return build_frame(reconstruction, prior, unit)


def infinite_homographies(frame: ReferenceFrame, planes: F64) -> F64:
    """Infinite homographies (B, R, 3, 3) of planes (B, 3) with determinant 1; NaN through a centre."""
    H = frame.homographies(planes)
    det = np.linalg.det(H)
    size = np.linalg.norm(H, axis=(-2, -1)) ** 3
    det = np.where(np.abs(det) > 1e-13 * size, det, np.nan)
    return np.asarray(H / np.cbrt(det)[..., None, None])


@dataclass(frozen=True)
class SolverUnknowns:
    """D unknown intrinsics and their positions in the calibrations of R cameras.

    ``index`` (R, 5) is the number of the unknown, -1 where ``known`` (R, 5) holds. Columns: log focal, log of
    aspect / prior aspect, skew, principal point x and y relative to the normalized frame. ``mean``, ``std``
    (D,) are a Gaussian prior; std inf: ``mean`` is only a starting value.
    """

    index: I64
    known: F64
    mean: F64
    std: F64

    @property
    def focals(self) -> I64:
        """Numbers of the unknown focal lengths."""
        return np.unique(self.index[self.index[:, 0] >= 0, 0])

    def calibrations(self, unknowns: F64) -> F64:
        """Build the unit-free calibrations (B, R, 3, 3) of unknowns (B, D)."""
        values = np.repeat(self.known[None], len(unknowns), axis=0)
        free = self.index >= 0
        values[:, free] = unknowns[:, self.index[free]]
        values[..., :2] = np.exp(np.clip(values[..., :2], (-12.0, -3.0), (12.0, 3.0)))
        return calibrations(values)

    def calibration_std(self, unknowns: F64, covariance: F64) -> F64:
        """Propagate a covariance (D, D) of unknowns (D,) to the entries of K (R, 3, 3), to first order."""
        slope = central_differences(lambda x: self.calibrations(x[None])[0], unknowns)
        variance = np.einsum("rijd,de,rije->rij", slope, covariance, slope)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def prior_residuals(self, unknowns: F64) -> F64:
        """Return (unknowns - mean) / std (B, D), 0 without a prior."""
        known = np.isfinite(self.std)
        scale = np.where(known, self.std, 1.0)
        return np.where(known, (unknowns - self.mean) / scale, 0.0)

    def with_focal_prior(self) -> "SolverUnknowns":
        """Replace missing focal priors: 1.2 long sides within a factor of 2.5."""
        mean, std = self.mean.copy(), self.std.copy()
        unknown = self.focals[~np.isfinite(std[self.focals])]
        mean[unknown], std[unknown] = np.log(1.2), np.log(2.5)
        return replace(self, mean=mean, std=std)

    def from_log_focals(self, log_f: F64) -> F64:
        """Return starts (B, D) for log focal lengths (B, R): their medians; prior means elsewhere."""
        unknowns = np.repeat(self.mean[None], len(log_f), axis=0)
        for k in self.focals:
            unknowns[:, k] = np.median(log_f[:, self.index[:, 0] == k], axis=1)
        return unknowns


def solver_unknowns(frame: ReferenceFrame, prior: IntrinsicsPrior) -> SolverUnknowns:
    """Derive the unknowns of the registered cameras from the prior: std 0 makes a value known."""
    rows, unit = frame.views, frame.pixel_from_unit[frame.views]
    mean, std = np.zeros((len(rows), _N_INTRINSICS)), prior.std[rows, :_N_INTRINSICS].copy()
    focal = prior.mean[rows, 0]
    unknown = ~(np.isfinite(focal) & np.isfinite(std[:, 0]))
    mean[:, 0] = np.log(np.where(unknown, unit[:, 0, 0], focal) / unit[:, 0, 0])
    std[unknown, 0] = np.inf
    std[:, 1] /= prior.mean[rows, 1]
    mean[:, 2] = prior.mean[rows, 2] / unit[:, 0, 0]
    std[:, 2:4] /= unit[:, :1, 0]
    std[:, 4] /= unit[:, 1, 1]
    index = np.full(mean.shape, -1, dtype=np.int64)
    means: list[float] = []
    stds: list[float] = []
    for column in range(_N_INTRINSICS):
        shared = prior.shared[rows, column]
        for number in np.unique(shared[std[:, column] > 0.0]):
            those = np.flatnonzero((shared == number) & (std[:, column] > 0.0))
            index[those, column] = len(means)
            means.append(float(mean[those[0], column]))
            stds.append(float(std[those[0], column]))
    return SolverUnknowns(index, mean, np.array(means), np.array(stds))


@dataclass(frozen=True)
class ConicConstraints:
    """Linear constraints on the image of the absolute conic.

    ``std`` (R, 4) are standard deviations of skew, principal point x and y, and half the aspect, inf where
    unknown; ``first`` (R,) is the place of the first camera with the same constant K.
    """

    std: F64
    first: I64
    reference: int


def conic_constraints(frame: ReferenceFrame, prior: IntrinsicsPrior) -> ConicConstraints:
    """Derive the conic constraints from the prior; views that share or know all intrinsics have one K."""
    rows = frame.views
    unit = frame.pixel_from_unit[rows, 0, :1]
    std = np.column_stack([prior.std[rows, 2:5] / unit, prior.std[rows, 1] / prior.mean[rows, 1] / 2.0])
    # Only without skew are w_12 = 0 and w_11 = w_22.
    std[np.ix_(prior.mean[rows, 2] != 0.0, [0, 3])] = np.inf
    # A constant K in pixels is constant in unit-free coordinates only if all its views share these.
    known = np.where(prior.std[rows, :5] == 0.0, prior.mean[rows, :5], np.nan)
    shared, units = prior.shared[rows, :5], frame.pixel_from_unit[rows]
    same_value = (known[:, None] == known[None]) | (shared[:, None] == shared[None])
    same_unit = np.isclose(units[:, None], units[None]).all(axis=(2, 3))
    first = (same_value.all(axis=2) & same_unit).argmax(axis=1).astype(np.int64)
    return ConicConstraints(std, first, frame.reference)


def square_pixel_constraints(frame: ReferenceFrame) -> ConicConstraints:
    """Return the constraints of square pixels and a central principal point, with no constant K."""
    n = len(frame.views)
    return ConicConstraints(np.tile(_SQUARE_PIXEL_STD, (n, 1)), np.arange(n, dtype=np.int64), frame.reference)


@dataclass(frozen=True)
class ProjectiveScene:
    """A projective reconstruction in a frame, and its prior."""

    reconstruction: Reconstruction
    frame: ReferenceFrame
    constraints: ConicConstraints
    unknown: SolverUnknowns


def projective_scene(reconstruction: Reconstruction, prior: IntrinsicsPrior) -> ProjectiveScene:
    """Return the input of the stratified methods in a normalized frame."""
    frame = normalized_frame(reconstruction, prior)
    constraints, unknown = conic_constraints(frame, prior), solver_unknowns(frame, prior)
    return ProjectiveScene(reconstruction, frame, constraints, unknown)
