"""Corners, matches and tracks of other programs: checks, and the steps of Algorithm 1 that take them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy

from thesisrecon.arrays import F64, I64, numbers, rows_of_views, sizes_of_images
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import Notice, UsageError, counted
from thesisrecon.io import _images
from thesisrecon.io._files import require_image_name
from thesisrecon.matching._prepared import select_found
from thesisrecon.matching.tracks import corners_from_matches
from thesisrecon.optimize.bundle.projection import Observations, read_observations, sort_observations
from thesisrecon.pipeline import matching
from thesisrecon.pipeline.large_sets import tracks_of_part
from thesisrecon.pipeline.lens import bent_pair, lens_of_matches, straight_matches
from thesisrecon.pipeline.run import Batch, Job, Run, stream
from thesisrecon.records import Features, Image, Matches, PairChoice, Tracks, TwoView, common_points
from thesisrecon.runtime._run_folder import key_of

PairMatches = I64 | tuple[F64, F64]
"""Matches of a pair: rows (M, 2) of the keypoints of both images, or positions (M, 2) in both images."""
MAX_OUTSIDE_REL = 0.02
"""Largest distance of a keypoint from its image, in long sides: detectors may pass the border a little."""
MIN_COMMON_POINTS = 16  # pairs of images with fewer common tracks are not verified


@dataclass(frozen=True)
class Given:
    """The front end that takes corners (N_i, 2) of V views, their matches, and tracks; None: to be built."""

    corners: Sequence[F64]
    matches: Sequence[Matches]
    tracks: Tracks | None = None

    @property
    def divides(self) -> bool:
        """Given tracks are not divided into groups."""
        return self.tracks is None

    def detect(self, job: Job) -> Sequence[Features]:
        """The given corners."""
        run, found = job.run, list[Features]()
        for i, xy in enumerate(self.corners):
            ones = np.ones(len(xy), dtype=np.float32)
            key = run.key("features", "given", xy)
            found.append(run.cached("features", f"{i:05d}", key, partial(Features, xy, ones, ones)))
        counts = [len(xy) for xy in self.corners]
        report = {"images": len(counts), "corners": sum(counts), "fewest_in_one_image": min(counts)}
        run.finish("features", counts=report)
        return found

    def prepare(self, job: Job, features: Sequence[Features]) -> Sequence[Any]:
        """Tracks are built from the corners alone."""
        return [SimpleNamespace(features=found) for found in features]

    def select(self, job: Job, features: Sequence[Features]) -> PairChoice:
        """The pairs with given matches."""
        pairs = np.array([(m.i, m.j) for m in self.matches], dtype=np.int64).reshape(-1, 2)
        key = job.run.key("pairs", "given", pairs)
        compute = partial(PairChoice, pairs, "the pairs with matches")
        choice: PairChoice = job.run.cached("pairs", "choice", key, compute)
        matching.report_choice(job, choice)
        return choice

    def lens(self, job: Job) -> F64 | None:
        """The lens that the given matches show."""
        return lens_of_matches(job, self.matches)

    def match(self, job: Job, views: Sequence[Any], choice: PairChoice | None) -> Sequence[TwoView]:
        """Estimate and verify the epipolar geometry of the given matches (chapter 5)."""
        run, matches = job.run, self.matches
        variants = [run.variant_key(stage) for stage in ("epipolar", "verification")]
        given = [[m.xy1, m.xy2, m.index1, m.index2] for m in matches]
        lens = [None if job.prior.lens is None else job.prior.lens[[m.i, m.j]] for m in matches]
        keys = {
            f"{m.i:05d}-{m.j:05d}": run.key("matches", "given", variants, content, run.seed, *bent)
            for m, content, bent in zip(matches, given, ([] if k is None else [k] for k in lens), strict=True)
        }

        def batches(missing: Sequence[int]) -> Iterator[Batch]:
            ends = ([matches[n].i, matches[n].j] for n in missing)
            sizes = (job.sizes[pair] for pair in ends)
            return (
                ([n], (job.config, matches[n], run.seed, lens[n], s))
                for n, s in zip(missing, sizes, strict=True)
            )

        return matching.report_matches(job, run.map_cached("matches", keys, _verify, batches))

    def track(
        self, job: Job, views: Sequence[Any], pairs: Sequence[TwoView], among: Sequence[int] | None = None
    ) -> Tracks:
        """The given tracks, or those of the matches."""
        if self.tracks is None:
            return matching.FromImages().track(job, views, pairs)
        some = self.tracks if among is None else tracks_of_part(self.tracks, np.array(among))
        return matching.report_given(job.run, some, pairs)


@dataclass(frozen=True)
class Views:
    """Names, original sizes (V, 2) and images (or folder) of a set; sizes are upright or ``as_stored``."""

    names: list[str]
    sizes: I64
    images: Path | Sequence[Any] | None
    as_stored: bool = False

    def read(self, run: Run, digests: Sequence[str]) -> _images.ImageSet:
        """The images at working size, or grey placeholders of original size; each with its input digest."""
        return _images.ImageSet(tuple(self._read(run, i, digest) for i, digest in enumerate(digests)), {})

    def _read(self, run: Run, i: int, digest: str) -> _images.DecodedImage:
        width, height = (int(side) for side in self.sizes[i])
        if self.images is None:
            return _images.DecodedImage(
                _images.image_without_pixels(self.names[i], (width, height), (width, height)), digest
            )
        source = self.images / self.names[i] if isinstance(self.images, Path) else self.images[i]
        size = run.config.images.max_size_px
        (found,) = _images.read_image(source, max_size_px=size, as_stored=self.as_stored).decoded
        if found.image.original_size != (width, height):
            now, rule = found.image.original_size, _images.rotation_words(self.as_stored)
            raise UsageError(Notice("wrong-image-size", self.names[i], *now, width, height, rule))
        image = replace(found.image, name=self.names[i])
        return replace(found, image=image, digest=key_of(digest, found.digest))


def views_of(sizes: Any, names: Sequence[str] | None, images: Any, *, as_stored: bool = False) -> Views:
    sizes = sizes_of_images(sizes)
    try:
        (table,) = numbers("a run", sizes=sizes)
        table = table.reshape(len(table), 2)
    except ValueError:
        raise UsageError("sizes must be (V, 2): width and height of each image in pixels") from None
    if not (np.isfinite(table).all() and (table >= 1).all() and (table == np.rint(table)).all()):
        raise UsageError("sizes must be whole numbers of pixels, at least 1")
    count = len(table)
    given = range(count) if names is None else _listed("names", names, count)
    names = [f"image-{name}" if names is None else str(name) for name in given]
    if len(set(names)) != count:
        raise UsageError(f"names must be {count} different names, one for each size; got {len(set(names))}")
    for name in names:
        require_image_name(name, "the list of names")
    if isinstance(images, str | Path):
        folder = Path(images)
        missing = [name for name in names if not (folder / name).is_file()]
        if missing:
            raise UsageError(Notice("missing-named-images", len(missing), count, folder, missing[0]))
        images = folder
    elif images is not None:
        images = _images.eight_bit_images(*_listed("images", images, count))
    return Views(names, table.astype(np.int64), images, as_stored)


def given_matches(
    keypoints: Sequence[F64] | None, matches: Mapping[tuple[int, int], PairMatches], views: Views
) -> Given:
    count = len(views.names)
    if keypoints is not None:
        keypoints = _listed("keypoints", keypoints, count)
    if not isinstance(matches, Mapping):
        raise UsageError(Notice("no-table-of-matches", type(matches).__name__))
    corners = None if keypoints is None else [_positions(xy, i, views) for i, xy in enumerate(keypoints)]
    found: list[Matches] = []
    for key, given in sorted(matches.items()):
        i, j = _pair(key, count, matches)
        where = f"matches of images {i} and {j}"
        if isinstance(given, tuple | list) and len(given) == 2 and _dimensions(given[0]) == 2:
            xy1, xy2 = _positions(given[0], i, views), _positions(given[1], j, views)
            if len(xy1) != len(xy2):
                raise UsageError(Notice("unequal-positions", where, len(xy1), len(xy2)))
            rows = np.full((len(xy1), 2), -1)
        elif corners is None:
            raise UsageError(f"{where} are rows of keypoints, but keypoints is None")
        else:
            rows = _rows(given, (i, j), corners)
            xy1, xy2 = corners[i][rows[:, 0]], corners[j][rows[:, 1]]
        found.append(_match_record((i, j), rows[:, 0], rows[:, 1], xy1, xy2))
    if not found:
        raise UsageError("there are no matches")
    positions = [bool(len(m.xy1) and m.index1[0] < 0) for m in found]
    if any(positions) and any(len(m.xy1) and not p for m, p in zip(found, positions, strict=True)):
        raise UsageError("matches must all be rows of keypoints or all be positions")
    if any(positions) or corners is None:
        corners, found = corners_from_matches(found, count)
    turned = (m if m.i < m.j else _match_record((m.j, m.i), m.index2, m.index1, m.xy2, m.xy1) for m in found)
    return Given(corners, list(turned))


def _listed(name: str, given: Any, count: int) -> list[Any]:
    """The things of a list, one for each size."""
    try:
        found = list(np.asarray(given) if hasattr(given, "__array__") else given)
    except Exception:
        what = f"a list with one for each of the {count} sizes"
        raise UsageError(f"{name} must be {what}; got a {type(given).__name__}") from None
    if len(found) != count:
        raise UsageError(f"there are {name} of {len(found)} images and {count} sizes")
    return found


def _dimensions(value: Any) -> int:
    """Number of axes; 2 of lists of different lengths and of what cannot be read, which is refused later."""
    try:
        return np.ndim(value)
    except Exception:
        return 2


def _pair(key: Any, count: int, matches: Mapping[Any, Any]) -> tuple[int, int]:
    try:
        i, j = (int(view) for view in key)
    except (TypeError, ValueError):
        raise UsageError(f"a key of matches is (i, j), two image numbers; got {key!r}") from None
    if i == j or not (0 <= i < count and 0 <= j < count):
        raise UsageError(Notice("no-images-of-matches", i, j, count - 1))
    if i > j and (j, i) in matches:
        raise UsageError(f"matches of images {j} and {i} are given twice")
    return i, j


def _positions(xy: Any, i: int, views: Views) -> F64:
    """Checked positions (N, 2) of one image."""
    name = views.names[i]
    try:
        (found,) = numbers(f"the image {name!r}", keypoints=xy)
    except ValueError as error:
        advice = "of OpenCV's keypoints take [k.pt for k in keypoints]"
        raise UsageError(f"keypoints of {name!r} must be (N, 2) numbers: {error}; {advice}") from None
    if found.size == 0:
        return np.zeros((0, 2))
    if found.ndim != 2 or found.shape[1] != 2 or not np.isfinite(found).all():
        raise UsageError(f"keypoints of {name!r} must be (N, 2) finite positions; got shape {found.shape}")
    size = views.sizes[i]
    outside = np.maximum(-found, found - size + 1).max()
    if outside > MAX_OUTSIDE_REL * size.max():
        x, y = found.max(axis=0)
        raise UsageError(Notice("keypoints-outside", name, x, y, outside, *size))
    return found


def _rows(given: Any, pair: tuple[int, int], corners: Sequence[F64]) -> I64:
    """Checked rows (M, 2) of keypoints; of several matches of a keypoint only the first is kept."""
    where = f"matches of images {pair[0]} and {pair[1]}"
    if np.ma.is_masked(given):
        raise UsageError(f"{where} have rows that are hidden by a mask; leave them out")
    try:
        rows = np.asarray(given)
    except Exception:
        raise UsageError(Notice("no-rows-of-keypoints", where, "unequal", type(given).__name__)) from None
    if rows.size == 0:
        return np.zeros((0, 2), dtype=np.int64)
    if rows.ndim != 2 or rows.shape[1] != 2 or not np.issubdtype(rows.dtype, np.integer):
        raise UsageError(Notice("no-rows-of-keypoints", where, rows.shape, rows.dtype))
    one, two = (len(corners[view]) for view in pair)
    if rows.min() < 0 or (rows.max(axis=0) >= (one, two)).any():
        raise UsageError(f"{where} point to a keypoint that does not exist ({one} and {two} are given)")
    rows = rows.astype(np.int64)
    # Detectors repeat a position with another orientation or scale.
    for side, view in enumerate(pair):
        same = np.unique(corners[view], axis=0, return_inverse=True)[1].ravel()
        first = np.full(len(same), -1)
        first[same[::-1]] = np.arange(len(same))[::-1]
        rows[:, side] = first[same[rows[:, side]]]
        rows = rows[np.sort(np.unique(rows[:, side], return_index=True)[1])]
    return rows


def _match_record(pair: tuple[int, int], index1: I64, index2: I64, xy1: F64, xy2: F64) -> Matches:
    score, affine = np.ones(len(xy1), dtype=np.float32), np.tile(np.eye(2), (len(xy1), 1, 1))
    return Matches(*pair, index1, index2, xy1, xy2, score, affine)


def given_tracks(tracks: Tracks | F64, views: Views) -> Given:
    """The matches of all pairs of images that share enough points."""
    count = len(views.names)
    if not isinstance(tracks, Tracks):
        kinds = "thesisrecon.Tracks or an array of pixels (V, N, 2), NaN or masked where a point is not seen"
        # A list may hold keypoints of each image, whose rows do not belong together.
        if isinstance(tracks, list | tuple):
            raise UsageError(f"tracks must be {kinds}; got a {type(tracks).__name__}")
        try:
            (xy,) = numbers("tracks", missing=("tracks",), tracks=tracks)
        except ValueError as error:
            raise UsageError(f"tracks must be {kinds}: {error}") from None
        if xy.ndim != 3 or xy.shape[2] != 2:
            raise UsageError(f"tracks must be {kinds}; got a {type(tracks).__name__} {xy.shape}")
        point, view = np.nonzero(np.isfinite(xy).all(axis=2).T)
        tracks = Tracks(view, point, xy[view, point], *xy.shape[:2])
    if tracks.n_views != count:
        raise UsageError(f"there are tracks of {tracks.n_views} images and {count} sizes")
    try:
        view, point, pixels = read_observations("a list of tracks", tracks)
        sort_observations(Observations(view, point, pixels), count, tracks.n_points)
    except ValueError as error:
        raise UsageError(f"the tracks are not valid: {error}") from None
    # One observation of a point in a view, sorted by point and view.
    _, kept = np.unique(point * count + view, return_index=True)
    kept = kept[np.bincount(point[kept], minlength=tracks.n_points)[point[kept]] >= 2]
    view, point, xy = view[kept], point[kept], pixels[kept]
    here = rows_of_views(view, count)
    corners = [_positions(xy[rows], i, views) for i, rows in enumerate(here)]
    found: list[Matches] = []
    common = scipy.sparse.triu(common_points(view, point, count), 1).tocoo()
    pairs = np.column_stack([common.row, common.col])[common.data >= MIN_COMMON_POINTS]
    for i, j in pairs[np.lexsort(pairs.T[::-1])].tolist():
        _, a, b = np.intersect1d(point[here[i]], point[here[j]], return_indices=True)
        found.append(_match_record((i, j), a, b, corners[i][a], corners[j][b]))
    if not found:
        raise UsageError(Notice("no-shared-tracks", MIN_COMMON_POINTS, counted(tracks.n_points, "point")))
    _, number = np.unique(point, return_inverse=True)
    return Given(corners, found, Tracks(view, number, xy, count, int(number.max()) + 1))


def outside_masks(given: Given, images: Sequence[Image]) -> Given:
    """``given`` without matches and observations in masked pixels; all at working size."""
    if all(image.mask is None for image in images):
        return given
    clear = [
        np.ones(len(xy), bool) if image.mask is None else matching.values_at(image.mask, xy)
        for image, xy in zip(images, given.corners, strict=True)
    ]
    matches = [select_found(m, clear[m.i][m.index1] & clear[m.j][m.index2]) for m in given.matches]
    t = given.tracks
    if t is None:
        return replace(given, matches=matches)
    kept = np.empty(len(t.xy), bool)
    kept[np.argsort(t.view_index, kind="stable")] = np.concatenate(clear)
    kept &= np.bincount(t.point_index[kept], minlength=t.n_points)[t.point_index] >= 2
    numbers, point = np.unique(t.point_index[kept], return_inverse=True)
    tracks = Tracks(t.view_index[kept], point, t.xy[kept], t.n_views, len(numbers))
    return replace(given, matches=matches, tracks=tracks)


def at_working_size(given: Given, images: Sequence[Image]) -> Given:
    """``given`` in pixels at working size."""
    scales = np.array([image.scale for image in images])
    if (scales == 1.0).all():
        return given

    def scaled(xy: F64, scale: Any) -> F64:
        return np.asarray((xy + 0.5) * scale - 0.5)

    corners, found, t = zip(given.corners, scales, strict=True), given.matches, given.tracks
    tracks = None if t is None else replace(t, xy=scaled(t.xy, scales[t.view_index][:, None]))
    matches = [replace(m, xy1=scaled(m.xy1, scales[m.i]), xy2=scaled(m.xy2, scales[m.j])) for m in found]
    return Given([scaled(xy, s) for xy, s in corners], matches, tracks)


def _verify(
    config: PipelineConfig, matches: Matches, seed: int, lens: F64 | None, sizes: I64
) -> list[TwoView]:
    rng = stream(seed, "matches", matches.i, matches.j)
    if lens is None:
        return [matching.verify_matches(config, matches, rng)]
    return [
        bent_pair(matching.verify_matches(config, straight_matches(matches, sizes, lens), rng), sizes, lens)
    ]
