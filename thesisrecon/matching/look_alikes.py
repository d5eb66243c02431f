"""Images that a model places side by side although they show different sides, rooms or houses.

Matches of places that look alike agree with one geometry, since nothing else of the images is matched. But
two images from nearly the same direction show the same everywhere: corners of every textured part of one have
a similar corner on their epipolar line in the other, as often as those of the parts where the images were
matched. If they have one as rarely as on lines beside it, the places differ (missing correspondences: Zach,
Irschara and Bischof, CVPR 2008).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import Notice
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.geometry.two_view import fundamental_from_cameras
from thesisrecon.matching._prepared import PreparedImage, prepare_image
from thesisrecon.matching._seeds import nearest_neighbours
from thesisrecon.matching.growth import match_guided
from thesisrecon.records import Features, Image, Reconstruction, common_points

MAX_TURN, NEAREST, MIN_COMMON = np.tan(np.radians(12.0)), 0.1, 40
"""Images of at least so many common points are near if they stand apart by at most this part of the distance
to the nearest tenth of the points of either: along a street, close walls change before the far end does."""
NEIGHBOURS, MOST = 4, 60  # images of most common points that each is compared with; pairs in all
MIN_SIMILAR, MIN_CONTRAST = 0.8, 8.0  # correlation of a counterpart; standard deviation of textured windows
GRID, MIN_CORNERS, MIN_COMMON_IN_PART = (6, 5), 15, 4
"""Parts of an image along its sides, textured corners from which one counts, and common points by which it
tells how often corners repeat."""
EVIDENCE = 3.0  # log ratio of likelihoods, 20 to 1, from which a part shows the same or something else
MAX_DIFFERENT, MIN_DIFFERENT = 0.22, 6
"""Parts that show something else, of both images of a pair: share and number from which the pair is doubtful.
Of right models at most 0.11 (0.33 and five parts in a crowd), of equal sides 0.25 to 0.42."""
MAX_NAMED = 6  # pairs that a sentence names


def swapped_pairs(
    model: Reconstruction, images: Sequence[Image], features: Sequence[Features]
) -> list[tuple[int, int]]:
    """Pairs of near images with different surroundings, for images most of whose near pairs are like that."""

    @lru_cache(maxsize=8)
    def view(v: int) -> PreparedImage:
        return prepare_image(images[v], features[v])

    near, found = _near_pairs(model), list[tuple[int, int]]()
    for i, j, xy1, xy2 in near:
        if len(features[i].xy) and len(features[j].xy):
            one, two = view(i), view(j)
            there = _different(model, i, j, (one, two), (images[i], xy1, xy2))
            if min(there, _different(model, j, i, (two, one), (images[j], xy2, xy1))) > MAX_DIFFERENT:
                found.append((i, j))
    compared, different = (
        np.bincount([v for p in pairs for v in p[:2]], minlength=len(images)) for pairs in (near, found)
    )
    wrong = 2 * different > compared
    return [(i, j) for i, j in found if wrong[i] or wrong[j]]


def swapped_sentence(pairs: Sequence[tuple[int, int]]) -> Notice:
    """The failed check of such pairs."""
    named = "; ".join(f"#{i} and #{j}" for i, j in pairs[:MAX_NAMED])
    more = f"; and {len(pairs) - MAX_NAMED} more pairs" if len(pairs) > MAX_NAMED else ""
    return Notice("swapped-images", named + more)


def _near_pairs(model: Reconstruction) -> list[tuple[int, int, F64, F64]]:
    """Pairs of views that see their common points from nearly the same place, and these points in both."""
    t, here = model.tracks, np.flatnonzero(model.registered)
    k = np.flatnonzero(model.used)
    k = k[np.lexsort((t.point_index[k], t.view_index[k]))]
    common = scipy.sparse.coo_array(common_points(t.view_index[k], t.point_index[k], t.n_views))
    upper = (common.row < common.col) & (common.data >= MIN_COMMON)
    i, j, count = common.row[upper], common.col[upper], common.data[upper]
    rank = np.full(len(i), NEIGHBOURS)
    for v in here:
        own = np.flatnonzero((i == v) | (j == v))
        order = own[np.argsort(-count[own], kind="stable")]
        rank[order] = np.minimum(rank[order], np.arange(len(own)))
    chosen = np.flatnonzero(rank < NEIGHBOURS)
    chosen = chosen[np.lexsort((j[chosen], i[chosen]))]
    X, C, rows = dehomogenize(model.X), np.zeros((t.n_views, 3)), [k[:0]] * t.n_views
    close = np.zeros(t.n_views)
    C[here] = dehomogenize(camera_centre(model.P[here]))
    for v in here:
        rows[v] = k[t.view_index[k] == v]
        if len(rows[v]):
            close[v] = np.quantile(np.linalg.norm(X[t.point_index[rows[v]]] - C[v], axis=1), NEAREST)
    found = []
    for a, b in zip(i[chosen].tolist(), j[chosen].tolist(), strict=True):
        if np.linalg.norm(C[a] - C[b]) <= MAX_TURN * min(close[a], close[b]):
            one, two = np.intersect1d(*(t.point_index[rows[v]] for v in (a, b)), return_indices=True)[1:]
            found.append((a, b, t.xy[rows[a][one]], t.xy[rows[b][two]]))
    return found[:: 1 + len(found) // MOST]


def _different(
    model: Reconstruction, a: int, b: int, views: tuple[PreparedImage, PreparedImage],
    common: tuple[Image, F64, F64],
) -> float:  # fmt: skip
    """Share of the textured parts of image a that show something else in image b."""
    (one, two), (image, xy1, xy2) = views, common
    xy, size, long_side = one.features.xy, np.array(one.size), two.long_side
    # The common points predict where a corner is, to a tenth of the image.
    design = np.column_stack([xy1, np.ones(len(xy1))])
    plane = np.linalg.lstsq(design, xy2, rcond=None)[0]
    rest = xy2 - design @ plane
    place = xy @ plane[:2] + plane[2] + rest[nearest_neighbours(xy1, xy, 5)].mean(axis=1)
    F = fundamental_from_cameras(model.P[a], model.P[b])
    normal = np.column_stack([xy, np.ones(len(xy))]) @ F[:2].T
    aside = np.median(normal * np.sign(normal @ np.median(normal, axis=0))[:, None], axis=0)
    aside *= 0.05 * long_side / max(float(np.linalg.norm(aside)), 1e-300)
    affine = np.tile(plane[:2].T, (len(xy), 1, 1))
    limits = np.full(len(xy), 0.1 * long_side), np.full(len(xy), 0.006 * long_side)
    similar = list[B8]()
    for shift in (np.zeros(2), aside, -aside):
        moved = F.copy()
        moved[2] -= shift @ F[:2]
        index = match_guided(
            one.pyramid, (xy, one.features.scale), (affine, place + shift, limits[0]),
            (two.features.xy, two.features.scale, two.patches), two.cells, (moved, limits[1], MIN_SIMILAR),
        )[0]  # fmt: skip
        similar.append(index >= 0)
    inside = ((xy > 0.06 * size) & (xy < 0.94 * size)).all(axis=1)
    inside &= ((place > 0.06 * np.array(two.size)) & (place < 0.94 * np.array(two.size))).all(axis=1)
    # Standard deviation of the grey levels around the corners.
    gray = image.gray.astype(np.float64)
    mean, square = (scipy.ndimage.uniform_filter(g, 9) for g in (gray, gray**2))
    x, y = np.clip(np.rint(xy).astype(np.int64), 0, np.array(gray.shape[::-1]) - 1).T
    use = inside & (np.sqrt(np.maximum(square - mean**2, 0.0))[y, x] > MIN_CONTRAST)

    def in_parts(xy: F64) -> I64:
        """Number of places in each part of the image."""
        part = np.minimum((xy / size * GRID).astype(np.int64), np.array(GRID) - 1) @ [1, GRID[0]]
        return np.bincount(part, minlength=GRID[0] * GRID[1])

    count, here, *beside = (in_parts(xy[use & s]) for s in (inside, *similar))
    dense = count >= MIN_CORNERS
    matched = dense & (in_parts(xy1) >= MIN_COMMON_IN_PART)
    # How often corners have a counterpart where the images show the same, and by chance.
    repeated = np.clip(here[matched].sum() / max(count[matched].sum(), 1), 0.05, 0.95)
    chance = (np.maximum(*beside).sum() + 1.0) / (count.sum() + 2.0)
    if matched.sum() < 3 or repeated <= chance:
        return 0.0
    hit, missed = np.log(repeated / chance), np.log((1.0 - repeated) / (1.0 - chance))
    ratio = (here * hit + (count - here) * missed)[dense]
    different, same = np.count_nonzero(ratio < -EVIDENCE), np.count_nonzero(ratio > EVIDENCE)
    return different / (different + same) if different >= MIN_DIFFERENT else 0.0
