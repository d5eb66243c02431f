"""Reconstruction from corners, matches or tracks of other programs: Algorithm 1 from chapter 5 on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Unpack

import numpy as np

from thesisrecon._settings import Config, as_config
from thesisrecon.arrays import F64, I64
from thesisrecon.errors import UsageError, counted
from thesisrecon.io._colmap_database import read_database
from thesisrecon.io._images import DecodedImage, ImageSet, images_folder, read_image
from thesisrecon.io._models import read_model
from thesisrecon.matching.tracks import AlignedTracks, PlainTracks, corners_from_matches
from thesisrecon.pipeline._given import Given, take_corners, take_pairs, take_tracks, verify_pairs
from thesisrecon.pipeline._outputs import RESULT_FILES
from thesisrecon.pipeline._stages import build_tracks
from thesisrecon.pipeline._state import PipelineState
from thesisrecon.pipeline._steps import STEPS, claimed, empty_result, identity_of, run_steps
from thesisrecon.records import Image, Matches, Tracks
from thesisrecon.results import RunResult
from thesisrecon.runtime._run import Progress, Run, RunOptions, start_run
from thesisrecon.runtime._run_folder import key_of

PairMatches = I64 | tuple[F64, F64]
"""Matches of a pair: rows (M, 2) of the keypoints of both images, or positions (M, 2) in both images."""
MAX_OUTSIDE_REL = 0.02
"""Largest distance of a keypoint from its image, in long sides: detectors may pass the border a little."""
MIN_COMMON_POINTS = 16
"""Pairs of images with fewer common tracks are not verified."""


def reconstruct_from_matches(
    keypoints: Sequence[F64] | None,
    matches: Mapping[tuple[int, int], PairMatches],
    sizes: Sequence[tuple[int, int]] | I64,
    out: str | Path | None = None,
    *,
    names: Sequence[str] | None = None,
    images: str | Path | Sequence[Any] | None = None,
    config: Config | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    **options: Unpack[RunOptions],
) -> RunResult:
    """Reconstruct metric cameras and points from matches of any program.

    The matches are verified (chapter 5), joined to tracks and used as those of the own front end.

    Parameters
    ----------
    keypoints : sequence of V ndarray (N_i, 2), or None
        Positions in pixels of the images, (0, 0) = centre of the top-left pixel; None if all matches are
        positions.
    matches : mapping
        (i, j) -> (M, 2) rows of ``keypoints[i]`` and ``keypoints[j]``; or a pair of (M, 2) positions in
        images i and j, which are joined to tracks where they lie within a pixel of each other.
    sizes : array_like (V, 2)
        Width and height of the images.
    out : path, optional
        Output folder, as for :func:`reconstruct`; None: nothing is kept but the result.
    names : sequence of V str, optional
        Names of the images; by default "image-0" and so on.
    images : path, or sequence of V path, array or Image, optional
        The images, for colours, depth maps and the textured model: a folder with files of these names, or the
        images in the order of the keypoints.
    config, seed, progress, **options
        As for :func:`reconstruct`. ``until`` is "metric" without images.

    Returns
    -------
    RunResult
        As of :func:`reconstruct`.

    Raises
    ------
    UsageError, StageFailure
        If the input contradicts itself; if it cannot be reconstructed.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from thesisrecon import Camera, reconstruct_from_matches
    >>> rng = np.random.default_rng(0)
    >>> K = np.array([[900.0, 0, 319.5], [0, 900, 239.5], [0, 0, 1]])
    >>> angles = np.radians([[0, -30, 5], [25, -15, 0], [-5, 0, 20], [15, 15, 0], [-20, 25, 5]])
    >>> X = rng.uniform(-1, 1, (200, 3))
    >>> R = Rotation.from_euler("xyz", angles).as_matrix()
    >>> cameras = [Camera(K, r, np.array([0, 0, 6.0]), (640, 480)) for r in R]
    >>> keypoints = [camera.project(X) + rng.normal(0, 0.3, (200, 2)) for camera in cameras]
    >>> same = np.column_stack([np.arange(200), np.arange(200)])
    >>> pairs = {(i, j): same for i in range(5) for j in range(i + 1, 5)}
    >>> result = reconstruct_from_matches(keypoints, pairs, [(640, 480)] * 5)
    >>> bool(abs(result.cameras[0].K[0, 0] - 900) < 5 * result.cameras[0].std["focal_px"])
    True
    """
    views = _views(sizes, names, images)
    given = _given_matches(keypoints, matches, views)
    return _reconstruct(given, views, out, config, seed, progress, options)


def reconstruct_from_tracks(
    tracks: Tracks,
    sizes: Sequence[tuple[int, int]] | I64,
    out: str | Path | None = None,
    *,
    names: Sequence[str] | None = None,
    images: str | Path | Sequence[Any] | None = None,
    config: Config | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    **options: Unpack[RunOptions],
) -> RunResult:
    """Reconstruct metric cameras and points from tracks of any program.

    Parameters
    ----------
    tracks : Tracks
        Observations in pixels of the images; wrong ones are found. Pairs of images are verified by the points
        that they share.
    sizes, out, names, images, config, seed, progress, **options
        As for :func:`reconstruct_from_matches`.

    Returns
    -------
    RunResult
        As of :func:`reconstruct`.

    Raises
    ------
    UsageError, StageFailure
        If the input contradicts itself; if it cannot be reconstructed.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from thesisrecon import Camera, Tracks, reconstruct_from_tracks
    >>> rng = np.random.default_rng(0)
    >>> K = np.array([[900.0, 0, 319.5], [0, 900, 239.5], [0, 0, 1]])
    >>> angles = np.radians([[0, -30, 5], [25, -15, 0], [-5, 0, 20], [15, 15, 0], [-20, 25, 5]])
    >>> X = rng.uniform(-1, 1, (200, 3))
    >>> R = Rotation.from_euler("xyz", angles).as_matrix()
    >>> cameras = [Camera(K, r, np.array([0, 0, 6.0]), (640, 480)) for r in R]
    >>> xy = np.concatenate([camera.project(X) for camera in cameras]) + rng.normal(0, 0.3, (1000, 2))
    >>> tracks = Tracks(np.repeat(np.arange(5), 200), np.tile(np.arange(200), 5), xy, 5, 200)
    >>> result = reconstruct_from_tracks(tracks, [(640, 480)] * 5)
    >>> bool(abs(result.cameras[0].K[0, 0] - 900) < 5 * result.cameras[0].std["focal_px"])
    True
    """
    views = _views(sizes, names, images)
    return _reconstruct(_given_tracks(tracks, views), views, out, config, seed, progress, options)


def reconstruct_from_colmap(
    path: str | Path,
    out: str | Path | None = None,
    *,
    images: str | Path | Sequence[Any] | None = None,
    config: Config | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    **options: Unpack[RunOptions],
) -> RunResult:
    """Reconstruct metric cameras and points from a COLMAP database or sparse model.

    Nothing of COLMAP's calibration and poses is used.

    Parameters
    ----------
    path : path
        A database with keypoints and matches (the verified matches, or the raw ones if there are none), or a
        folder with a sparse model of any kind of camera, binary or text, whose tracks are used.
    out, images, config, seed, progress, **options
        As for :func:`reconstruct_from_matches`; ``images`` is the folder of COLMAP's images.

    Returns
    -------
    RunResult
        As of :func:`reconstruct`.

    Raises
    ------
    UsageError, StageFailure
        If there is no database or model; if it cannot be reconstructed.
    """
    path = Path(path)
    if path.is_dir():
        model = read_model(path)
        if any(view.size is None for view in model.views) or not len(model.xy):
            raise UsageError(f"{path} holds no observations of points; give a COLMAP model or a database")
        order = np.lexsort((model.view_index, model.point_index))
        view, point = model.view_index[order], model.point_index[order]
        tracks = Tracks(view, point, model.xy[order], len(model.views), len(model.X))
        views = _views([view.size for view in model.views if view.size is not None], model.names, images)
        given = _given_tracks(tracks, views)
    else:
        database = read_database(path)
        views = _views(database.sizes, database.names, images)
        given = _given_matches(database.keypoints, database.matches, views)
    return _reconstruct(given, views, out, config, seed, progress, options)


@dataclass(frozen=True)
class _Views:
    """Names and original sizes (V, 2) of the images, and the images or where they are."""

    names: list[str]
    sizes: I64
    images: Path | Sequence[Any] | None

    def read(self, run: Run, digests: Sequence[str]) -> ImageSet:
        """The images at working size, or grey ones of original size; each with a digest of its input."""
        return ImageSet(tuple(self._read(run, i, digest) for i, digest in enumerate(digests)), {})

    def _read(self, run: Run, i: int, digest: str) -> DecodedImage:
        width, height = (int(side) for side in self.sizes[i])
        if self.images is None:
            return DecodedImage(Image.without_pixels(self.names[i], (width, height)), digest)
        source = self.images / self.names[i] if isinstance(self.images, Path) else self.images[i]
        (found,) = read_image(source, max_size_px=run.config.images.max_size_px).decoded
        if found.image.original_size != (width, height):
            is_now = "{} x {}".format(*found.image.original_size)
            rule = "width and height must be those of the image after EXIF rotation"
            raise UsageError(f"image {self.names[i]!r} is {is_now}, not {width} x {height}: {rule}")
        image = replace(found.image, name=self.names[i])
        return replace(found, image=image, digest=key_of(digest, found.digest))


def _views(sizes: Any, names: Sequence[str] | None, images: Any) -> _Views:
    try:
        table = np.asarray(sizes, dtype=np.float64).reshape(len(sizes), 2)
    except (TypeError, ValueError):
        raise UsageError("sizes must be (V, 2): width and height of each image in pixels") from None
    if not (np.isfinite(table).all() and (table >= 1).all() and (table == np.rint(table)).all()):
        raise UsageError("sizes must be whole numbers of pixels, at least 1")
    count = len(table)
    names = [f"image-{i}" for i in range(count)] if names is None else [str(name) for name in names]
    if len(names) != count or len(set(names)) != count:
        raise UsageError(f"names must be {count} different names, one for each size; got {len(names)}")
    if isinstance(images, str | Path):
        folder = Path(images)
        missing = [name for name in names if not (folder / name).is_file()]
        if missing:
            raise UsageError(
                f"{missing[0]!r} and {len(missing) - 1} more of {count} images are not in {folder}"
            )
        images = folder
    elif images is not None and len(images) != count:
        raise UsageError(f"there are {len(images)} images and {count} sizes")
    return _Views(names, table.astype(np.int64), images)


def _given_matches(
    keypoints: Sequence[F64] | None, matches: Mapping[tuple[int, int], PairMatches], views: _Views
) -> Given:
    count = len(views.names)
    corners = None if keypoints is None else [_positions(xy, i, views) for i, xy in enumerate(keypoints)]
    if corners is not None and len(corners) != count:
        raise UsageError(f"there are keypoints of {len(corners)} images and {count} sizes")
    found: list[Matches] = []
    for key, given in sorted(matches.items()):
        i, j = _pair(key, count, matches)
        pair = (
            given if isinstance(given, tuple | list) and len(given) == 2 and np.ndim(given[0]) == 2 else None
        )
        if pair is not None:
            xy1, xy2 = _positions(pair[0], i, views), _positions(pair[1], j, views)
            if len(xy1) != len(xy2):
                raise UsageError(
                    f"matches of images {i} and {j}: {len(xy1)} positions and {len(xy2)} positions"
                )
            none = np.full(len(xy1), -1)
            found.append(_match_record((i, j), none, none, xy1, xy2))
        else:
            if corners is None:
                raise UsageError(
                    f"matches of images {i} and {j} are rows of keypoints, but keypoints is None"
                )
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
    return Given(corners, [_forward(m) for m in found])


def _pair(key: Any, count: int, matches: Mapping[Any, Any]) -> tuple[int, int]:
    try:
        i, j = (int(view) for view in key)
    except (TypeError, ValueError):
        raise UsageError(f"a key of matches is (i, j), two image numbers; got {key!r}") from None
    if i == j or not (0 <= i < count and 0 <= j < count):
        raise UsageError(
            f"matches of images {i} and {j}: two different numbers from 0 to {count - 1} are needed"
        )
    if i > j and (j, i) in matches:
        raise UsageError(f"matches of images {j} and {i} are given twice")
    return i, j


def _positions(xy: Any, i: int, views: _Views) -> F64:
    """Checked positions (N, 2) of one image."""
    found = np.asarray(xy, dtype=np.float64)
    if found.size == 0:
        return np.zeros((0, 2))
    name = views.names[i]
    if found.ndim != 2 or found.shape[1] != 2 or not np.isfinite(found).all():
        raise UsageError(f"keypoints of {name!r} must be (N, 2) finite positions; got shape {found.shape}")
    size = views.sizes[i]
    outside = np.maximum(-found, found - size + 1).max()
    if outside > MAX_OUTSIDE_REL * size.max():
        x, y = found.max(axis=0)
        advice = "sizes are (width, height), positions (x, y)"
        raise UsageError(
            f"keypoints of {name!r} reach ({x:.0f}, {y:.0f}), {outside:.0f} px outside "
            f"{size[0]} x {size[1]} px: {advice}"
        )
    return found


def _rows(given: Any, pair: tuple[int, int], corners: Sequence[F64]) -> I64:
    """Checked rows (M, 2) of keypoints, each keypoint at most once: the first match counts."""
    rows = np.asarray(given)
    if rows.size == 0:
        return np.zeros((0, 2), dtype=np.int64)
    where = f"matches of images {pair[0]} and {pair[1]}"
    if rows.ndim != 2 or rows.shape[1] != 2 or not np.issubdtype(rows.dtype, np.integer):
        raise UsageError(
            f"{where} must be (M, 2) whole numbers, rows of keypoints; got {rows.shape} {rows.dtype}"
        )
    limits = [len(corners[view]) for view in pair]
    if rows.min() < 0 or (rows.max(axis=0) >= limits).any():
        raise UsageError(
            f"{where} point to a keypoint that does not exist ({limits[0]} and {limits[1]} are given)"
        )
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


def _forward(m: Matches) -> Matches:
    """The matches with i < j."""
    return m if m.i < m.j else _match_record((m.j, m.i), m.index2, m.index1, m.xy2, m.xy1)


def _given_tracks(tracks: Tracks, views: _Views) -> Given:
    """The matches of all pairs of images that share enough points."""
    count = len(views.names)
    view, point = np.asarray(tracks.view_index), np.asarray(tracks.point_index)
    if tracks.n_views != count or len(view) == 0 or view.max() >= count:
        raise UsageError(f"the tracks are of {tracks.n_views} images, the sizes of {count}")
    order = np.lexsort((point, view))
    _, first = np.unique(np.stack([point[order], view[order]]), axis=1, return_index=True)
    kept = np.sort(order[first])
    kept = kept[np.bincount(point[kept], minlength=tracks.n_points)[point[kept]] >= 2]
    view, point, xy = view[kept], point[kept], np.asarray(tracks.xy, dtype=np.float64)[kept]
    here = [np.flatnonzero(view == i) for i in range(count)]
    corners = [_positions(xy[rows], i, views) for i, rows in enumerate(here)]
    found: list[Matches] = []
    for i in range(count):
        for j in range(i + 1, count):
            _, a, b = np.intersect1d(point[here[i]], point[here[j]], return_indices=True)
            if len(a) >= MIN_COMMON_POINTS:
                found.append(_match_record((i, j), a, b, corners[i][a], corners[j][b]))
    if not found:
        raise UsageError(
            f"no two images share {MIN_COMMON_POINTS} of the {counted(tracks.n_points, 'point')}"
        )
    order = np.lexsort((view, point))
    _, number = np.unique(point[order], return_inverse=True)
    sorted_tracks = Tracks(view[order], number, xy[order], count, int(number.max()) + 1)
    return Given(corners, found, sorted_tracks)


def _at_working_size(given: Given, images: Sequence[Image]) -> Given:
    """The same in pixels at working size."""
    scales = np.array([image.scale for image in images])
    if (scales == 1.0).all():
        return given

    def scaled(xy: F64, scale: Any) -> F64:
        return np.asarray((xy + 0.5) * scale - 0.5)

    matches = [
        replace(m, xy1=scaled(m.xy1, scales[m.i]), xy2=scaled(m.xy2, scales[m.j])) for m in given.matches
    ]
    tracks = given.tracks
    if tracks is not None:
        tracks = replace(tracks, xy=scaled(tracks.xy, scales[tracks.view_index][:, None]))
    return Given([scaled(xy, s) for xy, s in zip(given.corners, scales, strict=True)], matches, tracks)


@contextmanager
def _folder(out: str | Path | None) -> Iterator[str | Path]:
    if out is not None:
        yield out
        return
    with TemporaryDirectory() as folder:
        yield folder


def _reconstruct(
    given: Given,
    views: _Views,
    out: str | Path | None,
    config: Config | None,
    seed: int,
    progress: Progress | None,
    options: Mapping[str, Any],
) -> RunResult:
    config = as_config(config)
    if isinstance(config.tracks, AlignedTracks):
        # There are no prepared images to align the observations with.
        config = replace(config, tracks=PlainTracks())
    with _folder(out) as folder:
        until, run, overwrite = start_run(folder, config, seed, progress, options)
        requested = options.get("until") is not None
        if views.images is None:
            if requested and until in ("dense", "model"):
                raise UsageError(f"until = {until!r} needs the images; give images, or until = 'metric'")
            until = "metric" if until == "model" else until
        else:
            run.images_folder = images_folder(views.images)
        with claimed(run, overwrite=overwrite):
            with run.clock("images"):
                digests = [key_of(views.names[i], views.sizes[i], xy) for i, xy in enumerate(given.corners)]
                inputs = views.read(run, digests)
                given = _at_working_size(given, inputs.images)
            run.finish("images", counts={"read": len(digests), "refused": 0})
            result = empty_result(run, inputs)
            state = PipelineState(run, inputs, result, until)
            content = [[m.i, m.j, m.xy1, m.xy2] for m in given.matches]
            identity = identity_of(run, inputs) | {"matches": key_of(content)}
            run.directory.adopt(identity, overwrite=overwrite, results=RESULT_FILES)
            found = run_steps(state, _steps(given, until), surface_required=requested)
        return found if out is not None else replace(found, out=None)


def _steps(given: Given, until: str) -> list[Any]:
    """The steps of Algorithm 1, the first ones replaced."""
    tracks = build_tracks if given.tracks is None else partial(take_tracks, given)
    front = [partial(take_corners, given), partial(take_pairs, given), partial(verify_pairs, given)]
    rest = STEPS[until][3:]
    return [*front[: len(STEPS[until])], *(tracks if step is build_tracks else step for step in rest)]
