"""The default matching: seeds without a search radius, guided matching along epipolar lines, alignment."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from thesisrecon._numba import empty, full, kernel, zeros
from thesisrecon.arrays import F32, F64, I64
from thesisrecon.errors import StageFailure, UsageError, require_range
from thesisrecon.geometry.two_view import epipolar_distance_std
from thesisrecon.matching import _seeds
from thesisrecon.matching._prepared import (
    SAMPLES,
    SIDE,
    EstimateFundamental,
    PreparedImage,
    affine_determinant,
    dot,
    empty_matches,
    join_matches,
    normalize_window,
    one_to_one,
    prepare_image,
    pyramid_level,
    sample_window,
    select_found,
    window_raster,
)
from thesisrecon.matching.track_alignment import align_corners, align_matches, strongest_distinct
from thesisrecon.records import Features, FundamentalFit, Image, Matches

# Minimum verified seeds of a pair, and minimum correlation of a guided match.
MIN_SEEDS, MIN_CORRELATION = 12, 0.7
MIN_UNIQUE, UNIQUE_SAMPLE = 0.1, 200
"""Least share of the matches whose corner of image 2 is the most similar one of the whole image, and number
of matches tested: accepted real pairs reach 0.28; of n equal copies in a pattern about 1 / n is best.
"""


@kernel
def _fit_local_affines(xy: F64, neighbours: I64, xy1: F64, xy2: F64, prior: F64) -> tuple[F64, F64, F64]:
    """Affine map of image 1 to image 2 around each of ``xy`` (N, 2) from its neighbouring matches (N, K)."""
    # Weights 1 / (d^2 + d_mean^2), Cauchy reweighting against other surfaces, and the mean of the maps
    # `prior` (M, 2, 2) for collinear neighbours. Returns map (N, 2, 2), position (N, 2) and its uncertainty
    # (N,) px.
    count, k = neighbours.shape
    affine, position, spread = empty((count, 2, 2)), empty((count, 2)), empty(count)
    offset, rest, a0, z = empty((k, 2)), empty((k, 2)), empty((2, 2)), empty((3, 2))
    distance2, residual2 = empty(k), empty(k)
    for n in range(count):
        mean2 = 0.0
        a0[:] = 0.0
        for m in range(k):
            i = neighbours[n, m]
            dx, dy = xy1[i, 0] - xy[n, 0], xy1[i, 1] - xy[n, 1]
            offset[m, 0], offset[m, 1] = dx, dy
            distance2[m] = dx * dx + dy * dy
            residual2[m] = 0.0
            mean2 += distance2[m] / k
            for p in range(2):
                for q in range(2):
                    a0[p, q] += prior[i, p, q] / k
        mean2 = mean2 + 1e-9
        for m in range(k):
            i, dx, dy = neighbours[n, m], offset[m, 0], offset[m, 1]
            rest[m, 0] = xy2[i, 0] - (a0[0, 0] * dx + a0[0, 1] * dy)
            rest[m, 1] = xy2[i, 1] - (a0[1, 0] * dx + a0[1, 1] * dy)
        scale2 = np.inf
        # The first round is unweighted.
        for _ in range(3):
            # Correction of the prior map, transposed, above the translation, by weighted least squares.
            xx = sxy = yy = x = y = total = 0.0
            xu = yu = u = xv = yv = v = 0.0
            for m in range(k):
                w = 1.0 / ((distance2[m] + mean2) * (1.0 + residual2[m] / (scale2 + 1e-9)))
                dx, dy = offset[m, 0], offset[m, 1]
                wx, wy, e, f = w * dx, w * dy, rest[m, 0], rest[m, 1]
                total, x, y = total + w, x + wx, y + wy
                xx, sxy, yy = xx + wx * dx, sxy + wx * dy, yy + wy * dy
                xu, yu, u = xu + wx * e, yu + wy * e, u + w * e
                xv, yv, v = xv + wx * f, yv + wy * f, v + w * f
            # Without the means, the translation leaves a symmetric system of two unknowns, positive by the
            # ridge. The prior weighs 5 % of the neighbours along one direction.
            ridge = 0.05 * total * mean2
            x, y = x / total, y / total
            xx, sxy, yy = xx - total * x * x + ridge, sxy - total * x * y, yy - total * y * y + ridge
            determinant = xx * yy - sxy * sxy
            xu, yu, xv, yv = xu - x * u, yu - y * u, xv - x * v, yv - y * v
            z[0, 0], z[1, 0] = (yy * xu - sxy * yu) / determinant, (xx * yu - sxy * xu) / determinant
            z[0, 1], z[1, 1] = (yy * xv - sxy * yv) / determinant, (xx * yv - sxy * xv) / determinant
            z[2, 0] = u / total - z[0, 0] * x - z[1, 0] * y
            z[2, 1] = v / total - z[0, 1] * x - z[1, 1] * y
            for m in range(k):
                dx, dy = offset[m, 0], offset[m, 1]
                ex = rest[m, 0] - (z[0, 0] * dx + z[1, 0] * dy + z[2, 0])
                ey = rest[m, 1] - (z[0, 1] * dx + z[1, 1] * dy + z[2, 1])
                residual2[m] = ex * ex + ey * ey
            scale2 = np.median(residual2)
        for p in range(2):
            for q in range(2):
                affine[n, p, q] = a0[p, q] + z[q, p]
        position[n, 0], position[n, 1] = z[2, 0], z[2, 1]
        spread[n] = np.sqrt(scale2)
    return affine, position, spread


@kernel
def match_guided(
    view1: tuple[F32, I64, float], corners1: tuple[F64, F32], predicted: tuple[F64, F64, F64],
    corners2: tuple[F64, F32, F32], grid2: tuple[float, I64, I64, I64], gate: tuple[F64, F64, float],
) -> tuple[I64, F32, F32]:  # fmt: skip
    """Most similar corner of image 2 near the predicted position and epipolar line of each corner."""
    # `view1`: pixels, levels, base; `corners1`: xy (N, 2), scale (N,); `predicted`: affine (N, 2, 2),
    # position (N, 2), radius (N,) px; `corners2`: xy, scale, patches (C, 225); `grid2`: cell size, shape
    # (2,), start, order; `gate`: F, half widths (N,) of the bands px, minimum correlation. Returns the corner
    # (-1: none), its correlation and the second best elsewhere (-1: none).
    pixels, levels, base = view1
    xy1, scale1 = corners1
    affine, position, radius = predicted
    xy2, scale2, patches2 = corners2
    F, band, least = gate
    count = len(xy1)
    index = full(count, -1, np.int64)
    score = zeros(count, np.float32)
    second_best = full(count, -1.0, np.float32)
    near, seen = empty(len(xy2), np.int64), empty(len(xy2), np.float32)
    window, raster = empty((2, SAMPLES), np.float32), window_raster(SIDE)
    ready, sizes, inverse = zeros(2, np.bool_), full(2, np.inf), empty((2, 2))
    for c in range(len(scale2)):
        sizes[0] = min(sizes[0], scale2[c])
    sizes[1] = 2.0 * sizes[0]
    for n in range(count):
        determinant = affine_determinant(affine[n])
        if determinant == 0.0:
            continue
        found = _corners_in_band(xy1[n], (position[n], radius[n]), (F, band[n]), xy2, grid2, near)
        if found == 0:
            continue
        # The window of the corner as seen in image 2, for each corner size; ready if usable.
        a, m = affine[n], np.sqrt(determinant)
        inverse[0, 0], inverse[0, 1] = a[1, 1] / determinant, -a[0, 1] / determinant
        inverse[1, 0], inverse[1, 1] = -a[1, 0] / determinant, a[0, 0] / determinant
        for t in range(2):
            ready[t] = False
            if 0.6 < scale1[n] * m / sizes[t] < 1.7:
                k = pyramid_level(sizes[t] / m, base, len(levels))
                to_level, step = 1.0 / (base * 2.0**k), inverse * sizes[t]
                if sample_window(pixels, levels[k], to_level, xy1[n], step, raster, window[t]):
                    ready[t] = normalize_window(window[t]) > 0.0
        best, top = -1, least
        for t in range(found):
            c = near[t]
            size = 0 if scale2[c] < 1.5 * sizes[0] else 1
            seen[t] = np.float32(-1.0)
            if ready[size]:
                seen[t] = dot(window[size], patches2[c])
                if seen[t] > top:
                    best, top = c, float(seen[t])
        if best >= 0:
            index[n], score[n] = best, top
            # Closer corners, in pixels of their scale, may be one scene point.
            apart = 3.0 * scale2[best]
            for t in range(found):
                dx, dy = xy2[near[t], 0] - xy2[best, 0], xy2[near[t], 1] - xy2[best, 1]
                if dx * dx + dy * dy > apart**2:
                    second_best[n] = max(second_best[n], seen[t])
    return index, score, second_best


@kernel
def _corners_in_band(
    xy1: F64, search: tuple[F64, float], epipolar: tuple[F64, float], xy2: F64,
    grid2: tuple[float, I64, I64, I64], near: I64,
) -> int:  # fmt: skip
    """Write to ``near`` the corners of image 2 inside radius and epipolar band; return their number."""
    position, radius = search
    F, band = epipolar
    cell, shape, start, order = grid2
    l0 = F[0, 0] * xy1[0] + F[0, 1] * xy1[1] + F[0, 2]
    l1 = F[1, 0] * xy1[0] + F[1, 1] * xy1[1] + F[1, 2]
    l2 = F[2, 0] * xy1[0] + F[2, 1] * xy1[1] + F[2, 2]
    length = np.sqrt(l0 * l0 + l1 * l1) + 1e-300
    if abs(l0 * position[0] + l1 * position[1] + l2) > (radius + band) * length:
        return 0
    first_x = max(int((position[0] - radius) / cell), 0)
    last_x = min(int((position[0] + radius) / cell), shape[1] - 1)
    first_y = max(int((position[1] - radius) / cell), 0)
    last_y = min(int((position[1] + radius) / cell), shape[0] - 1)
    if last_x < first_x:
        return 0
    found = 0
    for cy in range(first_y, last_y + 1):
        row = cy * shape[1]
        for at in range(start[row + first_x], start[row + last_x + 1]):
            c = order[at]
            dx, dy = xy2[c, 0] - position[0], xy2[c, 1] - position[1]
            if dx * dx + dy * dy > radius * radius:
                continue
            if abs(l0 * xy2[c, 0] + l1 * xy2[c, 1] + l2) > band * length:
                continue
            near[found] = c
            found += 1
    return found


@dataclass(frozen=True)
class SeedsAndGrowth:
    """Matching by seeds, then guided by their F and by local affine maps of known matches (4.2.2).

    F is estimated from the seeds whose neighbours have similar displacements, and also from all seeds if few
    of these or fewer than half agree; the F with more inliers is used. Patches rotated to their dominant
    gradient are matched if few upright ones agree with one F.
    """

    ratio: float = 0.8  #: maximum ratio of the distances to the best and second best match of a seed
    neighbours: int = 10  #: number of matches that define a local affine map
    growth: bool = True
    """Match all corners by guided search, those of the coarser scale first, else only corners at seeds."""
    rematch: bool = True
    """Repeat the guided matching with the F and the maps of its own matches. If these cover a third of the
    corners of image 1, only the other corners are matched again."""
    align: bool = True  #: align positions in image 2 by least-squares matching, else keep the corners
    many_images: int = 40
    """Number of images above which pairs are first matched with fewer corners and seeds, since many images
    show each point, and with all only if these give few matches or the images form a long sequence."""
    oblique_pairs: int = 6
    """Number of pairs of each image outside the largest group of matched images that are matched again with
    seeds of simulated oblique views; 0 for none."""

    # Minimum half width of the epipolar band, relative to the long side; three standard deviations of the
    # epipolar line if that is more.
    band_rel = 0.002
    grown_ratio = 0.8  # the ratio of guided matches, within their part of the epipolar band
    affine_std = 0.02  # prior standard deviation of an affine coefficient in the alignment
    many_share = 0.5  # share of the corners and seeds that are matched first

    def __post_init__(self) -> None:
        require_range(self, neighbours="[1, inf)", oblique_pairs="[0, inf)", ratio="(0, inf)")

    def prepare(self, image: Image, features: Features) -> PreparedImage:
        """See `thesisrecon.config.Matcher.prepare`."""
        return prepare_image(image, features)

    def match(
        self, view1: PreparedImage, view2: PreparedImage, *, pair: tuple[int, int],
        estimate_fundamental: EstimateFundamental, rng: np.random.Generator,
    ) -> Matches:  # fmt: skip
        """See `thesisrecon.config.Matcher.match`."""
        features1, features2 = view1.features, view2.features
        if features1.seeds is None or features2.seeds is None:
            raise UsageError(
                "seeds-and-growth matching needs features with seeds; set "
                "features.kind=multi-scale-corners, or matching.kind=strength-of-match"
            )
        # Faint and blurred images have seeds at the coarse levels only.
        if not (len(features1.xy) and len(features2.xy)):
            return empty_matches(pair)
        sets = _seeds.seed_matches(features1, features2, pair, ratio=self.ratio)
        start = _verified_seeds(sets, estimate_fundamental, rng)
        if start is None:
            return empty_matches(pair)
        if self.growth:
            grow = self._grow_in_rounds if features1.oblique is None else self._grow_around_seeds
            matches = grow(view1, view2, start, estimate_fundamental, rng)
        else:
            matches = _seeds.corners_of_seeds(view1.features.xy, view2.features.xy, start[0])
        if len(matches.xy1) and (share := _unique_share(view1, view2, matches)) < MIN_UNIQUE:
            raise StageFailure.of("repeated-pattern", len(matches.xy1), share)
        if not self.align:
            return select_found(matches, strongest_distinct(matches))
        return align_matches(view1, view2, matches, affine_std=self.affine_std)

    def _grow_around_seeds(
        self, view1: PreparedImage, view2: PreparedImage, start: tuple[Matches, FundamentalFit],
        estimate: EstimateFundamental, rng: np.random.Generator,
    ) -> Matches:  # fmt: skip
        """Match corners near few seeds, with maps accurate to 20 % and positions to a few pixels."""
        known, fit = start
        near = replace(self, neighbours=min(self.neighbours, 3))
        scale = np.full(len(known.xy1), view1.features.scale.max(), np.float32)
        places = (known.xy1, scale, known.xy2, known.affine)
        xy2, affine, score = align_corners(view1, view2, places, affine_std=0.2, max_shift=5.0)
        aligned = np.flatnonzero(score >= MIN_CORRELATION)
        if len(aligned) >= 8:
            known = select_found(replace(known, xy2=xy2, affine=affine), aligned)
        grown = near._grow_in_rounds(view1, view2, (known, fit), estimate, rng)
        verified = _verified(align_matches(view1, view2, grown, affine_std=0.1), estimate, rng)
        return grown if verified is None else near._grow_in_rounds(view1, view2, verified, estimate, rng)

    def _grow_in_rounds(
        self, view1: PreparedImage, view2: PreparedImage, start: tuple[Matches, FundamentalFit],
        estimate: EstimateFundamental, rng: np.random.Generator,
    ) -> Matches:  # fmt: skip
        """Match the corners of the coarser scale, then all, then all or the rest, guided by those before."""
        scale = view1.features.scale
        everything = np.arange(len(scale))
        # The coarser scale gives a better F for all.
        grown = self._grow(view1, view2, np.flatnonzero(scale > scale.min()), *start)
        start = _verified(grown, estimate, rng) or start
        grown = self._grow(view1, view2, everything, *start)
        if not self.rematch:
            return grown
        if len(grown.xy1) < len(scale) / 3.0:
            return self._grow(view1, view2, everything, *(_verified(grown, estimate, rng) or start))
        left = np.ones(len(scale), np.bool_)
        left[grown.index1] = False
        others = self._grow(view1, view2, np.flatnonzero(left), grown, start[1])
        both = join_matches([grown, others])
        rows = one_to_one(both.index2, both.score)
        return select_found(both, rows[np.argsort(both.index1[rows], kind="stable")])

    def _grow(
        self, view1: PreparedImage, view2: PreparedImage, chosen: I64, known: Matches, fit: FundamentalFit
    ) -> Matches:
        """Match the ``chosen`` corners of image 1, guided by F and the local maps of known matches."""
        # F is uncertain far from its matches: a narrow band would keep those that confirm its error.
        xy1, scale1 = view1.features.xy[chosen], view1.features.scale[chosen]
        near = _seeds.nearest_neighbours(known.xy1, xy1, min(self.neighbours, len(known.xy1)))
        affine, position, spread = _fit_local_affines(xy1, near, known.xy1, known.xy2, known.affine)
        long_side = view2.long_side
        radius = np.clip(3.0 * spread, 0.004 * long_side, 0.025 * long_side)
        std = epipolar_distance_std(fit.F, fit.covariance, xy1, position)
        band = np.fmax(self.band_rel * long_side, 3.0 * std)  # HZ 11.11; NaN: a method without covariance
        index, score, second_best = match_guided(
            view1.pyramid, (xy1, scale1), (affine, position, radius),
            (view2.features.xy, view2.features.scale, view2.patches), view2.cells,
            (fit.F, band, MIN_CORRELATION),
        )  # fmt: skip
        index[1.0 - score > self.grown_ratio**2 * (1.0 - second_best)] = -1
        rows = one_to_one(index, score)
        one, two, found = chosen[rows], index[rows], view2.features.xy[index[rows]]
        return Matches(known.i, known.j, one, two, xy1[rows], found, score[rows], affine[rows])


def _unique_share(view1: PreparedImage, view2: PreparedImage, matches: Matches) -> float:
    """Share of the matches whose corner of image 2 is at the most similar one of the whole image."""
    xy2, scale2 = view2.features.xy, view2.features.scale
    share = 0.0
    # Four times the limit in a few is no chance event (1e-5): most pairs end here.
    for count in (UNIQUE_SAMPLE // 6, UNIQUE_SAMPLE):
        some = select_found(matches, np.arange(0, len(matches.xy1), 1 + len(matches.xy1) // count))
        n = len(some.xy1)
        whole_image = np.full(n, 2.0 * view2.long_side)
        # Copies may lie off the epipolar lines of an F that they determine: F = 0 has no lines.
        best = match_guided(
            view1.pyramid, (some.xy1, view1.features.scale[some.index1]),
            (some.affine, some.xy2, whole_image), (xy2, scale2, view2.patches), view2.cells,
            (np.zeros((3, 3)), np.zeros(n), MIN_CORRELATION),
        )[0]  # fmt: skip
        apart = np.linalg.norm(xy2[best] - some.xy2, axis=1)
        share = float(np.mean((best < 0) | (apart <= 3.0 * scale2[best])))
        if share >= 4.0 * MIN_UNIQUE:
            break
    return share


def _verified_seeds(
    sets: Iterable[_seeds.SeedSet], estimate: EstimateFundamental, rng: np.random.Generator
) -> tuple[Matches, FundamentalFit] | None:
    """The largest set of seeds that agree with one F, and F; tries later sets only if few agree."""
    best: tuple[Matches, FundamentalFit] | None = None
    most = 0
    for seeds, support in sets:
        wide = support is _seeds.map_support
        # Of a strength of 10 at most; seeds whose maps are affine need less.
        supported = support(seeds) >= (1.0 if wide else 2.0)
        # So few seeds of simulated views are right that a wrong F of all may have more inliers.
        trials = (select_found(seeds, supported), *(() if wide else (seeds,)))
        for trial in trials if supported.sum() >= MIN_SEEDS else ():
            found = _verified(trial, estimate, rng)
            if found is not None and len(found[0].xy1) >= max(MIN_SEEDS, most + 1):
                best, most = found, len(found[0].xy1)
            # A second trial, with all seeds, helps weak pairs only.
            if most >= max(100, 0.5 * len(trial.xy1)):
                break
        if most >= max(50, 0.5 * len(seeds.xy1)):
            break
    return best


def _verified(
    matches: Matches, estimate: EstimateFundamental, rng: np.random.Generator
) -> tuple[Matches, FundamentalFit] | None:
    """The matches that agree with one F, and F; None if no F is found."""
    if len(matches.xy1) < 8:
        return None
    try:
        fit = estimate(matches.xy1, matches.xy2, rng)
    except StageFailure:
        return None
    return select_found(matches, fit.inliers), fit
