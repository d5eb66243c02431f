"""Finished runs and models of other programs: loaded, saved, aligned, scaled and compared."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import ArrayLike

from thesisrecon import results
from thesisrecon.api.cameras import triangulate
from thesisrecon.api.given import Model, as_sparse_model, cameras_of_model
from thesisrecon.api.lenses import undistort_points
from thesisrecon.arrays import B8, F64, Record, number, numbers, whole_number
from thesisrecon.camera import Camera
from thesisrecon.errors import Notice, UsageError, counted, in_words, require_word
from thesisrecon.geometry.homogeneous import scene_frame
from thesisrecon.geometry.strata import estimate_similarity, rotation_errors_deg
from thesisrecon.io._files import as_path, name_without_suffix, read_json
from thesisrecon.io._models import read_calibration, read_model, read_point_pairs, read_positions
from thesisrecon.metric.world import require_width, robust_similarity
from thesisrecon.pipeline.outputs import load_run, save_result
from thesisrecon.records import Similarity
from thesisrecon.results import ModelComparison, RunResult, SparseModel, SparseView
from thesisrecon.runtime._run_folder import RUN_FILE, ChangedRecord


@dataclass(frozen=True, eq=False)
class AlignmentReport(Record):
    """Result of an alignment to positions, in the unit of the positions."""

    similarity: Similarity  #: from the old to the new coordinates
    names: tuple[str, ...]  #: images with a position
    residual: F64  #: (N, 3) aligned centre minus position
    inlier: B8  #: (N,) positions used by the final fit
    sigma: float  #: standard deviation of one coordinate, estimated from the inliers
    unknown: tuple[str, ...] = ()  #: names of positions without an image in the model
    #: latitude and longitude (degrees) and height (m) of the origin if the positions were degrees
    origin: tuple[float, float, float] | None = None
    missing: tuple[str, ...] = ()  #: images whose position is None or NaN, left out

    @property
    def distance(self) -> F64:
        """Lengths (N,) of the residuals."""
        return np.asarray(np.linalg.norm(self.residual, axis=1))

    def __str__(self) -> str:
        """One line per position, and a summary."""
        lines = [
            f"{name}: {d:.4g}{'' if used else '  (outlier, not used)'}"
            for name, d, used in zip(self.names, self.distance, self.inlier, strict=True)
        ]
        rms = math.sqrt(float(np.mean(self.distance[self.inlier] ** 2)))
        total = f"{int(self.inlier.sum())} of {counted(len(self.names), 'position')} used"
        lines.append(f"{total}, residual {rms:.4g} RMS; 1 unit of the model is {self.similarity.scale:.6g}")
        if self.origin is not None:
            latitude, longitude, height = self.origin
            lines.append(
                "degrees were converted to metres east, north and up of latitude "
                f"{latitude:.7f}, longitude {longitude:.7f}, height {height:.7g} m (WGS84)"
            )
        if self.unknown:
            text = f"{counted(len(self.unknown), 'position')} without an image, such as {self.unknown[0]}"
            lines.append(text)
        if self.missing:
            text = f"{counted(len(self.missing), 'image')} without a position, such as {self.missing[0]}"
            lines.append(text)
        return "\n".join(lines)


def align_to_positions(
    model: Model, positions: Mapping[str, ArrayLike] | str | Path, *,
    seed: int = 0,
) -> tuple[SparseModel, AlignmentReport]:  # fmt: skip
    """Move a model to known positions of its cameras by a robust similarity.

    Similarities of triples of positions are compared by a quantile of their residuals (least median of
    squares, Rousseeuw 1984). The quantile gives the noise, and positions beyond its 99 % limit are left out
    of the least-squares fit.

    Parameters
    ----------
    model : path, RunResult, SparseModel, Reconstruction, mapping of str to Camera or sequence of Camera
        A model in memory (also of pycolmap), the output folder of a run, or a COLMAP model.
    positions : mapping of str to (3,), or path
        Image name -> position, in metres or any other unit of length; or a CSV file of ``name,x,y,z``. If
        its header names latitude, longitude and height (degrees and metres, WGS84), they become metres east,
        north and up of their median. Positions that are None, NaN or masked are left out.
    seed : int
        Random seed of the triples, which are drawn only for more than 18 positions.

    Returns
    -------
    SparseModel, AlignmentReport
        The model in the frame of the positions, and the residuals.

    Raises
    ------
    UsageError
        If fewer than three images have a position, a position is not three numbers, the positions look like
        degrees, or they or the camera centres lie on one line within their noise.

    Examples
    --------
    >>> from thesisrecon import align_to_positions, read_cameras, sample
    >>> cameras = read_cameras(sample() / "cameras.json")
    >>> places = {name: 2.5 * camera.centre + 10 for name, camera in cameras.items()}
    >>> aligned, report = align_to_positions(cameras, places)
    >>> round(report.similarity.scale, 6), bool(report.distance.max() < 1e-6)
    (2.5, True)
    """
    origin = None
    if isinstance(positions, str | PathLike):
        positions, origin = read_positions(Path(positions))
    if not isinstance(positions, Mapping):
        raise UsageError(Notice("no-positions", type(positions).__name__))
    whole_number("align_to_positions", "seed", seed, 0)
    model = as_sparse_model(model)
    centres = {view.name: view.centre for view in model.views}
    places = {name: _position(name, place) for name, place in positions.items() if name in centres}
    names = tuple(name for name, place in places.items() if place is not None)
    missing = tuple(name for name, place in places.items() if place is None)
    unknown = tuple(name for name in positions if name not in centres)
    if len(names) < 3:
        rest = f"; {unknown[0]!r} is not an image of the model" if unknown else ""
        rest = f"; that of {missing[0]!r} is missing" if missing else rest
        raise UsageError(f"alignment needs the positions of at least 3 images; got {len(names)}{rest}")
    source = np.array([centres[name] for name in names])
    target = np.array([places[name] for name in names])
    _require_lengths(target)
    require_width(source, "camera centres", 0.0)
    similarity, inlier, sigma = robust_similarity(source, target, seed)
    require_width(target[inlier], "positions", sigma)
    residual = similarity.apply(source) - target
    report = AlignmentReport(similarity, names, residual, inlier, sigma, unknown, origin, missing)
    return model.transformed(similarity), report


def _position(name: str, place: ArrayLike | None) -> F64 | None:
    """Three coordinates, or None if they are missing; UsageError that names the image for anything else."""
    if place is None:
        return None
    try:
        (found,) = numbers("alignment", missing=("position",), position=place)
    except ValueError:
        found = np.empty(0)
    if found.shape != (3,) or np.isinf(found).any():
        raise UsageError(f"alignment needs three coordinates of each position; that of {name} is {place!r}")
    return None if np.isnan(found).any() else found


def _require_lengths(positions: F64) -> None:
    """Refuse positions (N, 3) that are probably degrees: of a small spread, far from (0, 0)."""
    centre = np.median(positions[:, :2], axis=0)
    spread = float(np.quantile(np.abs(positions[:, :2] - centre), 0.75, axis=0).max())
    first, second = np.abs(positions[:, :2]).max(axis=0)
    inside = max(first, second) <= 180.0 and min(first, second) <= 90.0
    # Sites are smaller than 0.1 degrees (11 km) and far from (0, 0); lengths of this kind: a rig of 10 cm.
    if inside and spread < 0.1 and float(np.linalg.norm(centre)) > 100.0 * spread:
        raise UsageError(Notice("positions-in-degrees"))


def scaled(model: Model, name1: str, name2: str, distance: float) -> SparseModel:
    """Scale a model so that two camera centres have a known distance (section 3.4.4; HZ 10.2).

    Parameters
    ----------
    model : path, RunResult, SparseModel, Reconstruction, mapping of str to Camera or sequence of Camera
        As for :func:`align_to_positions`.
    name1, name2, distance : str, str, float
        Two images, and the distance of their camera centres in the new unit.

    Returns
    -------
    SparseModel
        The scaled model; the origin stays.

    Raises
    ------
    UsageError
        If an image is unknown, or a distance is not positive.

    Examples
    --------
    >>> from thesisrecon import sample, scaled
    >>> first, second, *_ = scaled(sample() / "cameras.json", "0000.jpg", "0001.jpg", 3.0).views
    >>> round(float(np.linalg.norm(first.centre - second.centre)), 6)
    3.0
    """
    model = as_sparse_model(model)
    centres = {view.name: view.centre for view in model.views}
    for name in (name1, name2):
        require_word("image", name, centres)
    distance = number("scaled", "distance", distance, "a positive number")
    now = float(np.linalg.norm(centres[name1] - centres[name2]))
    if not (0.0 < distance < math.inf and now > 0.0):
        raise UsageError(Notice("no-distance-of-cameras", distance, name1, name2, now))
    return model.transformed(Similarity.scaling(distance / now))


def scaled_by_points(
    model: Model, pixels: Mapping[str, ArrayLike] | str | Path, distance: float
) -> SparseModel:
    """Scale a model so that two points of the scene, seen in two or more images, have a known distance.

    Parameters
    ----------
    model : path, RunResult, SparseModel, Reconstruction, mapping of str to Camera or sequence of Camera
        As for :func:`align_to_positions`.
    pixels : mapping of str to (2, 2), or path
        Image name -> pixels of both points in the original image, such as the ends of a ruler; or a CSV file
        of ``name,x1,y1,x2,y2``.
    distance : float
        Distance of the points in the new unit.

    Returns
    -------
    SparseModel
        The scaled model; the origin stays.

    Raises
    ------
    UsageError
        If fewer than two images of the model are named, they do not show the points from two places, the
        pixels disagree, or the distance is not positive.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import read_cameras, sample, scaled_by_points
    >>> cameras = read_cameras(sample() / "cameras.json")
    >>> ends = np.array([[0.0, 0, 0], [0.5, 0, 0]])
    >>> pixels = {name: cameras[name].project(ends) for name in ("0000.jpg", "0005.jpg")}
    >>> moved = scaled_by_points(cameras, pixels, 2.0).views[0].centre
    >>> bool(np.allclose(moved, 4.0 * cameras["0000.jpg"].centre))
    True
    """
    if isinstance(pixels, str | PathLike):
        pixels = read_point_pairs(Path(pixels))
    if not isinstance(pixels, Mapping):
        raise UsageError(f"the scale needs pixels by image name, or a CSV file; got {in_words(pixels)}")
    model = as_sparse_model(model)
    cameras = cameras_of_model(model, "the model")
    if unknown := [name for name in pixels if name not in cameras]:
        raise UsageError(f"the pixels name {unknown[0]!r}, which is not an image of the model")
    xy = []
    for name, given in pixels.items():
        (ends,) = numbers("scaled_by_points", pixels=given)
        if ends.shape != (2, 2) or not np.isfinite(ends).all():
            raise UsageError(Notice("no-two-points", name, given))
        xy.append(ends)
    distance = number("scaled_by_points", "distance", distance, "a positive number")
    if len(xy) < 2 or not 0.0 < distance < math.inf:
        raise UsageError(Notice("no-distance-of-points", len(xy), distance))
    chosen = [cameras[name] for name in pixels]
    seen = np.stack([undistort_points(ends, one) for ends, one in zip(xy, chosen, strict=True)])
    ends = triangulate(np.stack([one.P for one in chosen]), seen)
    X = ends[:, :3] / ends[:, 3:]
    off = max(float(np.abs(one.project(X) - p).max()) for one, p in zip(chosen, xy, strict=True))
    longest = max(max(one.size) for one in chosen)
    now = float(np.linalg.norm(X[0] - X[1]))
    if not (np.isfinite(X).all() and now > 0.0 and off < 0.01 * longest):
        raise UsageError(Notice("other-points", off))
    return model.transformed(Similarity.scaling(distance / now))


def read_cameras(path: str | Path) -> dict[str, Camera]:
    """Read the cameras of a run, a ``cameras.json`` or a model of another program by image name.

    Parameters
    ----------
    path : str or Path
        Folder of a run or of a COLMAP model, or a ``cameras.json``: {"cameras": [...]} with name, K, R, t or
        C, width, height and perhaps three radial coefficients "distortion" each, or a table by name. Also a
        ``transforms.json`` (NeRF, nerfstudio), a ``par.txt`` (Middlebury) or a ``camchain.yaml`` (Kalibr;
        named cam0, cam1, ... in the frame of cam0).

    Returns
    -------
    dict of str to Camera
        In pixels of the original images, (0, 0) = centre of the top-left pixel; ``as_stored`` of COLMAP
        models and of runs from COLMAP's matches or tracks.

    Raises
    ------
    UsageError
        If there is no such file, it is damaged or empty, a camera has no K or size, or its lens is neither
        a pinhole nor radial.

    Examples
    --------
    >>> from thesisrecon import read_cameras
    >>> from thesisrecon.io._images import demo_images
    >>> cameras = read_cameras(demo_images()[0].parents[1] / "cameras.json")
    >>> cameras["0000.jpg"].size
    (1024, 768)
    """
    path = as_path("read_cameras", "path", path)
    if not path.exists():
        raise UsageError(f"there is no {path.name} in {path.parent}; no run has finished in this folder")
    return cameras_of_model(read_model(path), path)


def load(out: str | Path) -> RunResult:
    """Read the result of a finished run from its folder.

    Parameters
    ----------
    out : path
        Output folder of :func:`thesisrecon.reconstruct` or of the command.

    Returns
    -------
    RunResult
        As the run returned it, except for what is not stored: the pixels of ``images`` (grey), ``views`` and
        ``depth_maps``.

    Raises
    ------
    UsageError
        If no run has finished in the folder, or a file is damaged.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np
    >>> from thesisrecon import load, reconstruct
    >>> rng = np.random.default_rng(0)
    >>> images = [rng.integers(0, 256, (96, 128, 3), dtype=np.uint8) for _ in range(2)]
    >>> with TemporaryDirectory() as out:
    ...     found = len(reconstruct(images, out, until="features").features[0].xy)
    ...     len(load(out).features[0].xy) == found
    True
    """
    folder = as_path("load", "out", out)
    summary, run = read_json(folder / results.SUMMARY), read_json(folder / RUN_FILE)
    if not isinstance(summary, dict) or not isinstance(run, dict):
        raise UsageError(Notice("no-run", folder, results.SUMMARY, RUN_FILE))
    try:
        return load_run(folder, summary, run)
    except ChangedRecord as error:
        raise UsageError(f"a stored result is damaged ({error}); repeat the run in {folder}") from None
    except (KeyError, TypeError, ValueError, AttributeError):
        raise UsageError(f"{folder} does not hold a run of this version; repeat the run") from None


def save(result: RunResult, folder: str | Path, *, overwrite: bool = False) -> None:
    """Write ``cameras.json``, ``points.ply``, ``sparse/0``, ``model.glb`` and ``summary.json`` of a result.

    Parameters
    ----------
    result : RunResult
        Result of a run; if its output folder still holds it, the files are copied.
    folder : path
        Created if missing.
    overwrite : bool
        Replace files of these names that thesisrecon did not write, or that were changed since.

    Raises
    ------
    UsageError, OutputError
        If a file would be replaced; if a file cannot be written.

    Examples
    --------
    ``result`` as in the example of `thesisrecon.reconstruct_from_matches`:

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from thesisrecon import save
    >>> with TemporaryDirectory() as folder:
    ...     save(result, folder)
    ...     (Path(folder) / "cameras.json").is_file()
    True
    """
    if not isinstance(result, RunResult):
        raise UsageError(f"save needs a RunResult; got a {type(result).__name__}")
    save_result(result, as_path("save", "folder", folder), overwrite=overwrite)


def compare_models(
    a: Model, b: Model, *, max_time_difference: float = 0.01, time_offset: float = 0.0
) -> ModelComparison:
    """Compare two metric models of the same images after the similarity (Umeyama 1991) from a to b.

    Parameters
    ----------
    a, b : path, RunResult, SparseModel, Reconstruction, mapping of str to Camera or sequence of Camera
        Models (also of pycolmap); b is the reference. A path is the folder of a run, a COLMAP model, a
        ``cameras.json``, or a trajectory in TUM or KITTI format. b may also be a text file of the nine
        numbers of K: then only intrinsics are compared.
    max_time_difference, time_offset : float
        Largest difference in seconds of cameras that are paired by time, and what is added to the times of b.

    Returns
    -------
    ModelComparison
        Errors of each common camera, their summary, and the distances of the points.

    Raises
    ------
    UsageError
        If a model cannot be read or there is no common camera.

    Notes
    -----
    If one model is a trajectory and all names are times (seconds, or whole numbers of milli-, micro- or
    nanoseconds), each camera is paired with the nearest of the other model if that is true both ways. Others
    are paired by name; if no name is common, by name without folder and suffix; if there is none either, a
    trajectory without times by order with a model of as many cameras. ``notes`` says how. The similarity
    needs three common cameras whose centres are not on one line. Intrinsics are compared at the image size
    in b.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from thesisrecon import compare_models, read_cameras, sample
    >>> b = read_cameras(sample() / "cameras.json")
    >>> a = {name: replace(c, K=c.K * [[1.01], [1.01], [1]], t=0.5 * c.t) for name, c in b.items()}
    >>> comparison = compare_models(a, b)
    >>> round(comparison.similarity.scale, 6), comparison.focal_error_rel[:2].round(6).tolist()
    (2.0, [0.01, 0.01])
    >>> bool(comparison.summary["centre_error"]["max"] < 1e-9)
    True
    """
    first, notes = _model(a, "first"), list[str]()
    K = read_calibration(Path(b)) if isinstance(b, str | PathLike) else None
    second = _model(b, "second") if K is None else _of_calibration(K, first)
    tolerance = number("compare_models", "max_time_difference", max_time_difference)
    offset = number("compare_models", "time_offset", time_offset)
    if not (tolerance >= 0.0 and np.isfinite(offset)):
        raise ValueError(Notice("no-time-difference", tolerance, offset))
    pairs = paired_cameras(first, second, notes, tolerance, offset)
    left, right = [first.views[i] for i, _ in pairs], [second.views[j] for _, j in pairs]
    R, R_b = (np.array([view.R for view in views]) for views in (left, right))
    turned = unknown = np.full(len(pairs), np.nan)
    if K is None and len(pairs) > 1:
        turned = rotation_errors_deg(R, R_b)
    centres, centres_b = (np.array([view.centre for view in views]) for views in (left, right))
    if K is not None:
        notes.append("the reference is K alone: only intrinsics are compared")
    similarity = _similarity(centres, centres_b, notes) if K is None else None
    points = None
    if similarity is not None:
        first = first.transformed(similarity)
        points = _point_distances(first.X, second.X)
    intrinsics = np.array([_intrinsic_errors(*views) for views in zip(left, right, strict=True)])
    moved = unknown if similarity is None else np.linalg.norm(similarity.apply(centres) - centres_b, axis=1)
    paired, paired_b = ({pair[k] for pair in pairs} for k in (0, 1))
    return ModelComparison(
        names=tuple(view.name for view in left), names_b=tuple(view.name for view in right),
        centre_error=moved, rotation_error_deg=turned,
        focal_error_rel=intrinsics[:, 0], principal_point_error_px=intrinsics[:, 1], similarity=similarity,
        points=points, only_a=tuple(name for i, name in enumerate(first.names) if i not in paired),
        only_b=tuple(name for j, name in enumerate(second.names) if j not in paired_b), notes=tuple(notes),
        a=first, b=second,
    )  # fmt: skip


def _model(model: Model, which: str) -> SparseModel:
    found = as_sparse_model(model, f"the {which} model of a comparison")
    if not len(found.views):
        raise UsageError(Notice("model-without-camera", which))
    return found


def _of_calibration(K: F64, like: SparseModel) -> SparseModel:
    """The views of a model with this K and unknown poses (NaN)."""
    R, t = np.full((3, 3), np.nan), np.full(3, np.nan)
    return SparseModel([SparseView(view.name, R, t, K, view.size) for view in like.views])


def _pairs_by_time(
    a: SparseModel, b: SparseModel, tolerance: float, offset: float, notes: list[str]
) -> list[tuple[int, int]]:
    """Pairs of cameras that are nearest to each other in time; none unless a trajectory has times."""
    times, times_b = _times(a), _times(b)
    if times is None or times_b is None or not any(map(_is_trajectory, (a, b))):
        return []
    times_b = times_b + offset
    both = (times[:, None], times_b[:, None]), (times_b[:, None], times[:, None])
    nearest, nearest_a = (scipy.spatial.cKDTree(others).query(some)[1] for some, others in both)
    mutual = nearest_a[nearest] == np.arange(len(times))
    least = np.abs(times - times_b[nearest])
    pairs = [(int(i), int(nearest[i])) for i in np.flatnonzero(mutual & (least <= tolerance))]
    if not pairs:
        raise UsageError(Notice("no-common-times", least.min()))
    most = max(float(least[i]) for i, _ in pairs)
    counts = f"{len(pairs)} of {len(times)} and {counted(len(times_b), 'camera')}"
    given = f"at most {most:.3g} s apart (tolerance {tolerance:g} s, offset {offset:g} s)"
    notes.append(f"{counts} were paired by time, {given}")
    return pairs


def _is_trajectory(model: SparseModel) -> bool:
    return all(view.K is None for view in model.views)


def _times(model: SparseModel) -> F64 | None:
    """Times (V,) in seconds of names that are all numbers, with decimals or of epochs; None otherwise."""
    names = [name_without_suffix(view.name) for view in model.views]
    if not all(re.fullmatch(r"\d+(\.\d+)?([eE][+-]?\d+)?", name) for name in names):
        return None
    times = np.array(names, dtype=np.float64)
    if all(name.isdigit() for name in names):
        # Whole numbers are epochs of smaller units, or else the numbers of frames.
        unit = next((unit for unit in (1e9, 1e6, 1e3) if times.min() > 1e8 * unit), 1.0)
        return times / unit if times.min() > 1e8 else None
    return times


def paired_cameras(
    a: SparseModel, b: SparseModel, notes: list[str], tolerance: float = 0.01, offset: float = 0.0
) -> list[tuple[int, int]]:
    """Pairs of cameras of the same time or name in the order of a, as :func:`compare_models` pairs them."""
    if pairs := _pairs_by_time(a, b, tolerance, offset, notes):
        return pairs
    for key in (str, name_without_suffix, _number_of_dtu):
        keys, keys_b = ([key(view.name) for view in model.views] for model in (a, b))
        counts, counts_b = Counter(keys), Counter(keys_b)
        place = {name: j for j, name in enumerate(keys_b) if counts_b[name] == 1}
        pairs = [(i, place[name]) for i, name in enumerate(keys) if counts[name] == 1 and name in place]
        if pairs:
            return pairs
    if any(map(_is_trajectory, (a, b))) and len(a.views) == len(b.views):
        notes.append(f"no name is common; the {len(a.views)} cameras were paired by their order alone")
        return [(i, i) for i in range(len(a.views))]
    names = (f"{_few(model.names)} in the {which}" for which, model in (("first", a), ("second", b)))
    raise UsageError(Notice("no-common-camera", " and ".join(names)))


def _number_of_dtu(name: str) -> str:
    """The position in a name of DTU, such as rect_001_3_r5000.png and pos_001.txt, or else the name."""
    found = re.match(r"(?:rect|clean|pos)_(\d+)", name_without_suffix(name))
    return found[1] if found else name


def _few(names: Sequence[str]) -> str:
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(in_words(name) for name in names[:3]) + more


def _similarity(centres: F64, centres_b: F64, notes: list[str]) -> Similarity | None:
    """The similarity of the centres; a note if there is none, or if it is uncertain."""
    if len(centres) < 3:
        known = "rotations and intrinsics are compared" if len(centres) > 1 else "intrinsics are compared"
        text = f"{counted(len(centres), 'common camera')} cannot be aligned, at least 3 are needed; {known}"
        notes.append(text)
        return None
    try:
        similarity = estimate_similarity(centres, centres_b)
    except ValueError:
        notes.append(Notice("centres-on-a-line"))
        return None
    extents = (np.linalg.svd(C - C.mean(axis=0), compute_uv=False) for C in (centres, centres_b))
    if min(across / along for along, across, _ in extents) < 0.01:
        notes.append(Notice("centres-near-a-line"))
    return similarity


def _intrinsic_errors(a: SparseView, b: SparseView) -> tuple[float, float]:
    """Relative error of the focal length, and distance of the principal points in pixels of b."""
    if a.K is None or b.K is None:
        return np.nan, np.nan
    scale = np.divide(b.size, a.size) if a.size and b.size else np.ones(2)
    focal, focal_b = (np.sqrt(f[0] * f[1]) for f in (np.diag(a.K)[:2] * scale, np.diag(b.K)))
    offset = (a.K[:2, 2] + 0.5) * scale - 0.5 - b.K[:2, 2]
    return float(focal / focal_b - 1.0), float(np.linalg.norm(offset))


def _point_distances(X: F64, X_b: F64) -> results.PointDistances | None:
    if not (len(X) and len(X_b)):
        return None
    thresholds = np.array(results.THRESHOLDS) / scene_frame(X_b)[1]
    there, back = (scipy.spatial.cKDTree(to).query(of)[0] for of, to in ((X, X_b), (X_b, X)))
    within = [np.mean(distances[:, None] < thresholds, axis=0) for distances in (there, back)]
    return results.PointDistances(float(np.median(there)), float(np.median(back)), thresholds, *within)
