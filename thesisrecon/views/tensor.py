"""View synthesis from two images by the trilinear tensor (thesis, section 1.3).

After Avidan and Shashua (CVPR 1997, PAMI 1998). Cameras P1 = [I 0], P2 = [a, a_4], P3 = [b, b_4] have the
tensor T_i^jk = a_i^j b_4^k - a_4^j b_i^k. If the third camera moves to [Rb, R b_4 + t], T'_i^jk = R_l^k
T_i^jl + t^k a_i^j: one seed tensor gives all others. Unknown intrinsics are guessed, as in the thesis; new
views are then correct up to a projective transform of space. A pixel without correspondence is occluded in
the other image; it takes the depth of the nearest surrounding surface that would not stand in front of
anything the other image shows.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike

from thesisrecon import arrays
from thesisrecon.arrays import B8, F32, F64, I64, U8, Record
from thesisrecon.camera import rq
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import calibration_matrix, camera_centre
from thesisrecon.geometry.homogeneous import cross_matrix, dehomogenize, homogenize
from thesisrecon.geometry.relative_pose import depths_of_matches, poses_from_essential
from thesisrecon.geometry.two_view import enforce_rank_two, epipoles, require_parallax_of_matches
from thesisrecon.imaging.raster import run_in_strips
from thesisrecon.views._warping import distances_to_known, fill_holes, forward_map, known_around, sample

AGREE_PX = 1.5  #: tolerance of the forward-backward check: half a pixel of rounding and a pixel of noise


@dataclass(frozen=True, eq=False)
class CalibratedPair(Record):
    """Two calibrated cameras, X_2 = R X_1 + t. For two images |t| = 1 is the unit of length."""

    K1: F64  #: (3, 3) intrinsics, as is ``K2``
    K2: F64
    R: F64  #: (3, 3) and ``t`` (3,) from the first to the second camera frame
    t: F64

    @property
    def P2(self) -> F64:
        """The second camera [a, a_4] = [K2 R K1^-1, K2 t] (3, 4) beside P1 = [I 0], of points K1 X_1."""
        return np.column_stack([self.K2 @ self.R @ np.linalg.inv(self.K1), self.K2 @ self.t])

    @property
    def centre2(self) -> F64:
        """Centre (3,) of the second camera in the frame of the first."""
        return np.asarray(-self.R.T @ self.t)

    @property
    def swapped(self) -> "CalibratedPair":
        """The same cameras in the other order."""
        return CalibratedPair(self.K2, self.K1, self.R.T, self.centre2)


def default_intrinsics(size: tuple[int, int]) -> F64:
    """Return K with the long side as focal length and the principal point at the image centre."""
    f = float(max(size))
    return calibration_matrix(f, f, 0.5 * (size[0] - 1.0), 0.5 * (size[1] - 1.0))


def pair_from_fundamental(F: F64, xy1: F64, xy2: F64, *, K1: F64, K2: F64) -> CalibratedPair:
    """Compute the two cameras of F for given intrinsics (thesis, section 1.3); they have F exactly.

    The first has K1; of all second cameras that F allows, the left part is nearest to K2 R K1^-1 (least
    squares in coordinates of K2 and K1) with R from the essential matrix. Its K differs from K2 where F
    contradicts it.
    """
    in_front = 0.75  # Share of matches that must lie in front of both cameras
    require_parallax_of_matches(F, xy1, xy2)
    E = K2.T @ F @ K1
    rays1, rays2 = (homogenize(xy) @ np.linalg.inv(K).T for xy, K in ((xy1, K1), (xy2, K2)))
    R, t = poses_from_essential(E / np.linalg.norm(E))
    shares = (depths_of_matches(R, t, rays1, rays2) > 0.0).all(axis=2).mean(axis=1)
    best = int(np.argmax(shares))
    if not shares[best] >= in_front:
        raise StageFailure.of("scene-behind-cameras", 100.0 * shares[best], len(xy1), len(shares))
    return _pair_with(F, K1, K2, R[best], t[best])


def _pair_with(F: F64, K1: F64, K2: F64, R: F64, t: F64) -> CalibratedPair:
    """The pair that has F and is nearest to K1, K2, R, t."""
    F = enforce_rank_two(F)
    e2 = epipoles(F)[1]
    H = -cross_matrix(e2) @ F
    # Least squares for m and m v: K2^-1 m (H + e2 v') K1 is nearest to R.
    back = np.linalg.inv(K2)
    design = np.stack(
        [(back @ M @ K1).ravel() for M in (H, *(np.outer(e2, axis) for axis in np.eye(3)))], axis=1
    )
    wanted = K2 @ R @ np.linalg.inv(K1)
    m, *mv = np.linalg.lstsq(design, (back @ wanted @ K1).ravel(), rcond=None)[0]
    left = m * (H + np.outer(e2, np.asarray(mv) / m)) @ K1
    if not np.linalg.det(left) > 0.0:
        raise StageFailure.of("fundamental-against-intrinsics")
    own, turn = rq(left)
    baseline: F64 = np.asarray(np.linalg.solve(own, e2), dtype=np.float64)
    baseline *= np.sign(baseline @ t) / np.linalg.norm(baseline)
    return CalibratedPair(np.asarray(K1, dtype=np.float64), own / own[2, 2], turn, baseline)


@dataclass(frozen=True, eq=False)
class VirtualCamera(Record):
    """A virtual camera: the third camera of the seed tensor, moved from X_3 to R X_3 + t."""

    rotation: F64  #: R (3, 3)
    translation: F64  #: t (3,) in baselines
    K: F64  #: (3, 3)
    size: tuple[int, int]  #: width and height in pixels

    def __post_init__(self) -> None:
        R, t = (self.rotation, (3, 3)), (self.translation, (3,))
        arrays.require_rotations("view synthesis", arrays.checked("view synthesis", R=R, t=t)[0])
        arrays.require_calibration("view synthesis", self.K)
        if min(self.size) < 1:
            raise ValueError(f"an image is at least 1 x 1 px; got {self.size}")


def camera_at(
    pair: CalibratedPair, s: float, *, sizes: tuple[tuple[int, int], tuple[int, int]]
) -> VirtualCamera:
    """Place a virtual camera on the baseline; its rotation angle is the fraction ``s`` of that of the pair.

    K is interpolated if both sizes are equal, otherwise it is K2.
    """
    turned = (scipy.spatial.transform.Rotation.from_matrix(pair.R) ** s).as_matrix()
    share = min(max(s, 0.0), 1.0) if sizes[0] == sizes[1] else 1.0
    K = (1.0 - share) * pair.K1 + share * pair.K2
    # X_s = turned (X_1 - s C_2) and X_1 = R'(X_2 - t).
    motion = turned @ pair.R.T
    return VirtualCamera(motion, -s * turned @ pair.centre2 - motion @ pair.t, K, sizes[1])


@dataclass(frozen=True)
class VirtualTensor:
    """The tensor of two images and a virtual camera."""

    T: F64  #: (3, 3, 3) a_i^j b_4^k - a_4^j b_i^k with its scale, which determines signs and depths
    P2: F64  #: (3, 4) [a, a_4] beside P1 = [I 0], as :attr:`CalibratedPair.P2`
    K: F64  #: (3, 3) intrinsics of the third camera

    @property
    def P3(self) -> F64:
        """The third camera [b, b_4] (3, 4) with its scale, from nine linear equations per row."""
        design = np.zeros((3, 3, 4))
        design[:, :, 3] = self.P2[:, :3].T
        for i in range(3):
            design[i, :, i] = -self.P2[:, 3]
        return np.asarray(np.linalg.lstsq(design.reshape(9, 4), self.T.reshape(9, 3), rcond=None)[0].T)

    def moved(self, rotation: F64, translation: F64, *, K: F64 | None = None) -> "VirtualTensor":
        """Return the tensor after a motion of the third camera from X_3 to R X_3 + t."""
        K = self.K if K is None else K
        turn, shift = K @ rotation @ np.linalg.inv(self.K), K @ translation
        T = np.einsum("kl,ijl->ijk", turn, self.T) + np.einsum("k,ji->ijk", shift, self.P2[:, :3])
        return VirtualTensor(T, self.P2, K)

    def transfer(self, xy1: F64, xy2: F64, *, threads: int = 1) -> tuple[F64, F64]:
        """Transfer matches (N, 2) to the third image, with their inverse depths there, NaN behind a camera.

        x''^k = x^i l_j T_i^jk with the lines l through x2 perpendicular to the epipolar lines of x1.
        """
        places, inverse_depth = np.empty(xy1.shape), np.empty(len(xy1))
        a4 = self.P2[:, 3]

        def work(rows: tuple[int, int]) -> None:
            some = slice(*rows)
            x, x2 = homogenize(xy1[some]), xy2[some]
            a = x @ self.P2[:, :3].T
            # The direction of the epipolar line a_4 x a; its length cancels.
            l = a4[2] * a[:, :2] - a4[:2] * a[:, 2:]
            l = np.column_stack([l, -np.sum(l * x2, axis=1)])
            u, v, w = np.einsum("nj,njk->kn", l, np.tensordot(x, self.T, 1))
            # With l'(a x + rho a_4) = 0, x'' is -(l'a_4) (b x + rho b_4); a comparison with NaN is false.
            w = np.where(-w * (l @ a4) > 0.0, w, np.nan)
            places[some], inverse_depth[some] = np.stack([u / w, v / w], axis=1), np.sum(l * a, axis=1) / w

        run_in_strips(work, len(xy1), threads)
        return places, inverse_depth

    def disparity_per_inverse_depth(self, xy1: F64, xy2: F64) -> F64:
        """Return the displacement in image 2 per unit of inverse depth in the third view, to first order."""
        x, third = homogenize(xy1), self.P3[2]
        a, a4 = x @ self.P2[:, :3].T, self.P2[:, 3]
        e0, e1, _ = np.cross(a4, a).T
        lines = np.stack([e1, -e0, e0 * xy2[:, 1] - e1 * xy2[:, 0]], axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            rho = -np.sum(lines * a, axis=1) / (lines @ a4)
            # x_2 = (a + rho a_4) / w_2, and the inverse depth is rho / w_3.
            w2, w3 = a[:, 2] + rho * a4[2], x @ third[:3] + rho * third[3]
            along = np.linalg.norm(a4[:2] * a[:, 2:] - a[:, :2] * a4[2], axis=1) / w2**2
            return np.asarray(along * w3**2 / np.abs(x @ third[:3]))


def seed_of_two(pair: CalibratedPair, *, first: bool = False) -> VirtualTensor:
    """Return the seed tensor <1, 2, 2> of two views, in which one view is also the third."""
    P3, K = (np.eye(3, 4), pair.K1) if first else (pair.P2, pair.K2)
    a, a4, b, b4 = pair.P2[:, :3], pair.P2[:, 3], P3[:, :3], P3[:, 3]
    return VirtualTensor(np.einsum("ji,k->ijk", a, b4) - np.einsum("j,ki->ijk", a4, b), pair.P2, K)


def _extrapolated(inverse_depth: tuple[F32, F32], P2: F64, step: float) -> F32:
    """Complete the inverse depth of the first image of two from the surrounding pixels."""
    # The nearest known pixel in any direction that would not occlude a surface of the other image.
    own, other = inverse_depth
    y, x = np.nonzero(np.isnan(own))
    occluding, best = 2.0**40, np.full(len(y), np.inf)  # More than all squared distances
    found = np.full(len(y), np.nan, dtype=np.float32)
    for hole, at, squared in known_around(own, distances_to_known(own)):
        rank = squared + occluding * _occludes(other, P2, x[hole], y[hole], own[at].astype(np.float64), step)
        nearer = rank < best[hole]
        best[hole[nearer]], found[hole[nearer]] = rank[nearer], own[at][nearer]
    complete = own.copy()
    complete[y, x] = found
    return complete


def _occludes(other: F32, P2: F64, x: I64, y: I64, rho: F64, step: float) -> B8:
    """Whether pixels at inverse depths ``rho`` lie in front of the surface in the other image there."""
    u, v, w = (row[0] * x + row[1] * y + row[2] + rho * row[3] for row in P2)
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = np.rint(u / w), np.rint(v / w)
        inside = (row >= 0) & (row < other.shape[0]) & (column >= 0) & (column < other.shape[1])
        at = tuple(np.where(inside, place, 0).astype(np.int64) for place in (row, column))
        # A comparison with NaN is false.
        return np.asarray(~(w > 0.0) | (inside & (rho / w > other[at].astype(np.float64) + step)))


def _transfer_image(virtual: VirtualTensor, places: F32, *, threads: int = 1) -> tuple[F64, F32]:
    """Pixels (H, W, 2) of image 1 in the third view, and their inverse depth."""
    y, x = np.indices(places.shape[:2], dtype=np.float64)
    pixels, others = np.stack([x.ravel(), y.ravel()], axis=1), places.reshape(-1, 2).astype(np.float64)
    xy, inverse_depth = virtual.transfer(pixels, others, threads=threads)
    return xy.reshape(places.shape), inverse_depth.reshape(x.shape).astype(np.float32)


def _surface_step(virtual: VirtualTensor, places: F32) -> float:
    """``SURFACE_PX`` as a difference of inverse depth in the third view, for the median pixel."""
    surface_px = 1.0  # Largest difference of disparity between neighbouring pixels of one surface
    sparse = 16  # Subsampling step for medians
    known = np.isfinite(places[::sparse, ::sparse]).all(axis=2)
    y, x = (sparse * index for index in np.nonzero(known))
    pixels = np.stack([x, y], axis=1).astype(np.float64)
    found = virtual.disparity_per_inverse_depth(pixels, places[y, x].astype(np.float64))
    found = found[np.isfinite(found)]
    return surface_px / float(np.median(found)) if len(found) else np.inf


def _agreeing(places: F32, others: F32, agree_px: float) -> B8:
    """Pixels (H, W) that pass the forward-backward check."""
    if np.isinf(agree_px):
        return np.asarray(np.isfinite(places).all(axis=2))
    height, width = others.shape[:2]
    at = np.rint(places)
    inside = np.all((at >= 0) & (at <= np.array([width - 1, height - 1])), axis=2)
    x, y = np.where(inside[..., None], at, 0).astype(np.int64).transpose(2, 0, 1)
    own = np.indices(places.shape[:2])[::-1].transpose(1, 2, 0)
    # A comparison with NaN is false.
    return np.asarray(inside & (np.linalg.norm(others[y, x] - own, axis=2) <= agree_px))


def _completed(pair: CalibratedPair, places: F32, inverse_depth: tuple[F32, F32], step: float) -> F32:
    """``places`` (H, W, 2) with guesses for NaN, from the inverse depth of both images."""
    guessed = _extrapolated(inverse_depth, pair.P2, step)
    y, x = np.nonzero(np.isnan(inverse_depth[0]))
    X = np.stack([x, y, np.ones_like(x), guessed[y, x]], axis=1).astype(np.float64)
    complete = places.copy()
    complete[y, x] = dehomogenize(X @ pair.P2.T)
    return complete


@dataclass(frozen=True, eq=False)
class TensorSynthesis(Record):
    """Two images prepared for view synthesis by :func:`prepare_synthesis`."""

    pair: CalibratedPair
    levels: tuple[F32, F32]  #: (H, W, 4) colours, and 1 where the correspondence is known, 0 where guessed
    places: tuple[F32, F32]  #: (H, W, 2) corresponding pixels in the other image
    gain: F32  #: (3,) factor of the exposure of the second image

    @property
    def sizes(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Width and height of both images."""
        (h1, w1), (h2, w2) = (levels.shape[:2] for levels in self.levels)
        return (w1, h1), (w2, h2)

    def render(self, camera: VirtualCamera, *, threads: int = 1) -> U8:
        """Render a virtual camera: both images blended by its position, holes filled from behind."""
        min_seen = 0.05  # Minimum share of the image that must show the scene
        seeds = seed_of_two(self.pair), seed_of_two(self.pair.swapped, first=True)
        moved = [seed.moved(camera.rotation, camera.translation, K=camera.K) for seed in seeds]
        step = _surface_step(moved[0], self.places[0])
        layers = []
        for virtual, places, levels in zip(moved, self.places, self.levels, strict=True):
            xy, near = _transfer_image(virtual, places, threads=threads)
            source, front = forward_map(xy, near, size=camera.size, step=step, threads=threads)
            layers.append((sample(levels, source, threads=threads), front))
        seen: B8 = np.isfinite(layers[0][1]) | np.isfinite(layers[1][1])
        if not seen.mean() >= min_seen:
            raise StageFailure.of("virtual-view-without-scene", 100.0 * seen.mean(), 100.0 * min_seen)
        rgb, inverse_depth = self._mixed(layers, self._share_of_second(moved[0]), step)
        filled = fill_holes(rgb, inverse_depth, step=step)
        return np.clip(np.rint(np.nan_to_num(filled)), 0.0, 255.0).astype(np.uint8)

    def _share_of_second(self, virtual: VirtualTensor) -> np.float32:
        """Position of the camera along the baseline, clipped to 0 (first image) and 1 (second image)."""
        centre, baseline = camera_centre(virtual.P3), self.pair.centre2
        along = np.linalg.solve(self.pair.K1, centre[:3]) @ baseline / (centre[3] * baseline @ baseline)
        return np.float32(np.clip(along, 0.0, 1.0))

    def _mixed(self, layers: list[tuple[F32, F32]], share: np.float32, step: float) -> tuple[F32, F32]:
        """Blended colours and inverse depth of both layers, NaN where both are empty."""
        (first, near1), (second, near2) = layers
        of_second = _weight_of_second(layers, share, step)
        dark, bright = self.gain**-share, self.gain ** (1 - share)
        # Weights of 0 must not meet NaN.
        rgb = np.where((of_second < 1.0)[..., None], first[..., :3] * dark, 0.0) * (1 - of_second)[..., None]
        rgb += np.where((of_second > 0.0)[..., None], second[..., :3] * bright, 0.0) * of_second[..., None]
        return rgb, np.where(of_second > 0.5, near2, near1)


def _weight_of_second(layers: list[tuple[F32, F32]], share: np.float32, step: float) -> F32:
    """Blending weight (H, W) of the second image, NaN where both are empty."""
    # `share` on one surface; else the nearer surface is shown in the half of the baseline next to its own
    # image, with weight 0 in the last quarter before the other image, which does not show it.
    (first, near1), (second, near2) = layers
    seen1, seen2 = np.isfinite(near1), np.isfinite(near2)
    sure1, sure2 = np.nan_to_num(first[..., 3]) > 0.5, np.nan_to_num(second[..., 3]) > 0.5
    weight = np.full(near1.shape, share, dtype=np.float32)
    alike = seen1 & seen2 & (sure1 == sure2)
    weight[alike & (near2 > near1 + step)] = np.clip(4.0 * share - 1.0, 0.0, 1.0)
    weight[alike & (near1 > near2 + step)] = np.clip(4.0 * share - 2.0, 0.0, 1.0)
    # Known correspondences are used at any depth, except close to the image of the extrapolated pixel.
    weight[seen1 & seen2 & sure1 & ~sure2] = np.clip(4.0 * share - 3.0, 0.0, 1.0)
    weight[seen1 & seen2 & sure2 & ~sure1] = np.clip(4.0 * share, 0.0, 1.0)
    weight[seen1 & ~seen2] = 0.0
    weight[seen2 & ~seen1] = 1.0
    weight[~(seen1 | seen2)] = np.nan
    return weight


def prepare_synthesis(
    pair: CalibratedPair, images: tuple[ArrayLike, ArrayLike], places: tuple[F32, F32], *,
    gain: ArrayLike = (1.0, 1.0, 1.0), agree_px: float = AGREE_PX,
) -> TensorSynthesis:  # fmt: skip
    """Complete the correspondences of all pixels and prepare the images for any virtual camera."""
    known = _agreeing(places[0], places[1], agree_px), _agreeing(places[1], places[0], agree_px)
    for side in (0, 1):
        if not known[side].any():
            raise StageFailure.of("no-dense-correspondence", side + 1)
    pairs = pair, pair.swapped
    sure = [np.where(known[side][..., None], places[side], np.nan) for side in (0, 1)]
    own = [seed_of_two(one, first=True) for one in pairs]
    near = [_transfer_image(own[side], sure[side])[1] for side in (0, 1)]
    steps = [_surface_step(own[side], sure[side]) for side in (0, 1)]
    complete = [_completed(pairs[k], sure[k], (near[k], near[1 - k]), steps[1 - k]) for k in (0, 1)]
    levels = [
        np.concatenate([np.asarray(image, dtype=np.float32), seen[..., None].astype(np.float32)], axis=2)
        for image, seen in zip(images, known, strict=True)
    ]
    return TensorSynthesis(
        pair, (levels[0], levels[1]), (complete[0], complete[1]), np.asarray(gain, dtype=np.float32)
    )
