"""Rectified pairs, and depth maps, surface and texture of known cameras (thesis, sections 2.5 and 2.6)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from thesisrecon import records
from thesisrecon._numba import ThreadPool
from thesisrecon.api.given import CameraInput, as_cameras, named_cameras
from thesisrecon.arrays import F32, F64, I64, U8, number, numbers, resizing_transform
from thesisrecon.camera import Camera
from thesisrecon.config import DepthEstimator
from thesisrecon.config.text import Config, as_config
from thesisrecon.errors import Notice, StageFailure, UsageError, counted
from thesisrecon.imaging.pinholes import pinhole_numbers, pinhole_view
from thesisrecon.io import _images
from thesisrecon.lens import stacked_rows
from thesisrecon.pipeline.matching import ImageInput
from thesisrecon.runtime._blas import one_blas_thread
from thesisrecon.stereo._epipolar_pair import pair_of_fundamental
from thesisrecon.stereo.depth import MultiViewScene, keep_depths
from thesisrecon.stereo.rectification import METHODS, PLANAR, RectifiedImages, disparity_range
from thesisrecon.stereo.rectification import rectify as best_rectification
from thesisrecon.surface.model import SurfaceModel

ImagesInput = str | Path | Sequence[ImageInput]  # A folder, or images as files or arrays


def rectify(
    image1: ImageInput, image2: ImageInput, F: F64, xy1: F64, xy2: F64, *, planar: bool = False
) -> RectifiedImages:
    """Rectify two images by their fundamental matrix: epipolar lines become common rows (2.5; HZ 11.12).

    Parameters
    ----------
    image1, image2 : path or ndarray (H, W), (H, W, 3) or (H, W, 4) uint8
        Files, read at full size, or images.
    F, xy1, xy2 : ndarray (3, 3), (N, 2) and (N, 2)
        Fundamental matrix and N >= 8 of its inliers in pixels of these images.
    planar : bool
        Allow homographies only, which need epipoles outside the images.

    Returns
    -------
    RectifiedImages
        The rectified images, for :func:`match_rectified`, and the maps between them and the images.

    Raises
    ------
    StageFailure
        If the pair has no parallax or too few matches, or with ``planar`` an epipole lies inside an image.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import rectify
    >>> xy1 = np.random.default_rng(0).uniform(20, 140, (30, 2))
    >>> xy2 = xy1 - np.array([[8.0, 4]]) / np.random.default_rng(1).uniform(1, 4, (30, 1))
    >>> F = np.array([[0.0, 0, 4], [0, 0, -8], [-4, 8, 0]])
    >>> gray = np.full((160, 160), 128, np.uint8)
    >>> pair = rectify(gray, gray, F, xy1, xy2)
    >>> rows = [pair.rectified_from_original(k, xy)[:, 1] for k, xy in enumerate((xy1, xy2))]
    >>> bool(np.abs(rows[0] - rows[1]).max() < 1e-6)
    True
    """
    F, xy1, xy2 = numbers("rectify", F=F, xy1=xy1, xy2=xy2)
    images = _images.read_levels(image1, image2)
    size1, size2 = ((image.shape[1], image.shape[0]) for image in images)
    frame = best_rectification(pair_of_fundamental(F, xy1, xy2, size1, size2), PLANAR if planar else METHODS)
    return RectifiedImages.of(frame, (images[0], images[1]), disparity_range(frame, xy1, xy2))


@one_blas_thread()
def match_rectified(
    left: ImageInput, right: ImageInput, *, max_disparity_px: float, min_disparity_px: float = 0.0,
    config: Config | None = None,
) -> records.DisparityMap:  # fmt: skip
    """Compute the disparity map of a rectified pair (2.5; semi-global matching: Hirschmüller, PAMI 2008).

    Parameters
    ----------
    left, right : path, or array_like (H, W), (H, W, 3) or (H, W, 4)
        Two images of the same size: files (read at full size; ``UsageError`` or ``StageFailure`` if one
        cannot be read), or levels 0 to 255, 0 to 1 (floats) or of 16 bits, the same for both. Pixels that are
        NaN, masked or transparent are missing.
    max_disparity_px, min_disparity_px : float
        Largest and smallest disparity d, also negative ones; x_right = x_left - d.
    config : PipelineConfig, str or path, optional
        The matcher is ``config.dense.pairs``; None: the preset ``default``.

    Returns
    -------
    DisparityMap
        Disparity and confidence of each pixel of the left image, NaN where unknown.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import match_rectified
    >>> from scipy.ndimage import gaussian_filter
    >>> texture = gaussian_filter(128 + 300 * np.random.default_rng(0).uniform(-1, 1, (60, 90)), 1.0)
    >>> found = match_rectified(texture[:, :80], texture[:, 6:86], max_disparity_px=10)
    >>> round(float(np.nanmedian(found.disparity)), 1)
    6.0
    """
    images = _images.read_levels(left, right, grey=True)
    most = number("match_rectified", "max_disparity_px", max_disparity_px)
    least = number("match_rectified", "min_disparity_px", min_disparity_px)
    match = as_config(config).dense.match_rectified
    if least == 0.0:
        if not 0.0 <= most < np.inf:
            raise ValueError(f"match_rectified needs max_disparity_px of at least 0, finite; got {most:g}")
        return match(images[0], images[1], max_disparity_px=most)
    if not -np.inf < least <= most < np.inf:
        raise ValueError(Notice("disparity-range", least, most))
    first = int(np.floor(least))
    # One image moves to the right by whole columns, so that disparities begin at 0.
    places = max(-first, 0), max(first, 0)
    moved = [_shifted(image, place, places[0]) for image, place in zip(images, places, strict=True)]
    found = match(moved[0], moved[1], max_disparity_px=most - first)
    own = slice(places[0], None)
    return replace(
        found, disparity=found.disparity[:, own] + np.float32(first), confidence=found.confidence[:, own]
    )


def _shifted(image: U8 | F32, columns: int, more: int) -> F32:
    """An image moved to the right, NaN before it, in a frame with ``more`` columns."""
    height, width, *channels = image.shape
    out = np.full((height, width + more, *channels), np.nan, dtype=np.float32)
    kept = max(width + more - columns, 0)
    out[:, columns : columns + width] = image[:, :kept]
    return out


@one_blas_thread()
def depth_maps(
    images: ImagesInput, cameras: CameraInput, *, sizes: I64 | None = None,
    depth_range: F64 | tuple[float, float] | None = None, max_size: int | None = None,
    config: Config | None = None, threads: int = 1,
) -> tuple[records.DepthMap, ...]:  # fmt: skip
    """Estimate the depth maps of images with known cameras; no tracks or points are needed (2.5).

    Parameters
    ----------
    images : path or sequence of paths or ndarray (H, W), (H, W, 3) or (H, W, 4) uint8
        A folder (files in order of their names; with cameras by name those that have one), or V >= 2 images.
    cameras : sequence or mapping of Camera by file name, tuple (K, R, t), Reconstruction, RunResult or path
        Their cameras in pixels of the images (arrays with ``sizes``), after EXIF rotation unless they are
        ``as_stored``. If a reconstruction has points with observations, these give the depth range and the
        neighbours. Of a run from COLMAP's matches or tracks give ``result.cameras``.
    sizes : array_like (V, 2) or (2,), optional
        Image width and height, for plain arrays.
    depth_range : array_like (2,) or (V, 2), optional
        Nearest and farthest depth. None: from the cameras, see Notes.
    max_size : int, optional
        Larger images are reduced to this long side; None: ``config.images``.
    config, threads : PipelineConfig, str or Path, int
        ``config.dense`` is the method; number of threads, on which the result does not depend.

    Returns
    -------
    tuple of DepthMap
        Per image ``depth`` (H, W), NaN where unknown, its ``std``, and ``P`` = K [R t] for its pixels, which
        are undistorted and may be fewer than those of the image. Images wider than 110 degrees have several:
        ``view`` modulo V is the number of the image.

    Raises
    ------
    ValueError
        If a camera is missing or is not of its image's size, or the range is not 0 < nearest < farthest.
    StageFailure
        If no two images see common space, or no depth is found.

    Notes
    -----
    Without points and range, a pair is searched at the depths at which both images contain a point and its
    rays meet at 0.5 to 40 degrees. The neighbours of a view are those that share the most space with it at
    angles of about 10 degrees. A known range saves time and avoids errors.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.ndimage import gaussian_filter
    >>> from thesisrecon import Camera, depth_maps
    >>> wall = gaussian_filter(np.random.default_rng(0).uniform(-900, 1100, (96, 200)), 1.5)
    >>> wall = np.clip(wall, 0, 255).astype(np.uint8)
    >>> K = np.array([[120.0, 0, 63.5], [0, 120, 47.5], [0, 0, 1]])
    >>> shift = np.array([0, 12, 24])  # a plane at depth 10, seen from x = 0, 1, 2
    >>> images = [wall[:, s : s + 128] for s in shift]
    >>> cameras = [Camera(K, np.eye(3), np.array([-s / 12.0, 0, 0]), (128, 96)) for s in shift]
    >>> maps = depth_maps(images, cameras, depth_range=(5, 20))
    >>> round(float(np.nanmedian(maps[1].depth)), 1)
    10.0
    """
    method = as_config(config)
    read, model = _scene("depth_maps", images, cameras, sizes, max_size or method.images.max_size_px)
    limits, dense = None, method.dense
    if depth_range is not None:
        (given,) = numbers("depth_maps", depth_range=depth_range)
        if given.shape not in ((2,), (len(read), 2)):
            raise ValueError(Notice("shape-of-depth-range", len(read), given.shape))
        limits = np.broadcast_to(given, (len(read), 2))
        if not (np.isfinite(limits).all() and (limits[:, 0] > 0.0).all() and (np.diff(limits) > 0.0).all()):
            raise ValueError(f"depth_range needs 0 < nearest < farthest, both finite; got {depth_range}")
    scene = dense.prepare(read, model, depth_range=limits, threads=threads)
    if not any(scene.neighbours[view] for view in scene.views):
        raise StageFailure.of("no-depth-of-cameras")
    maps = list(confirmed_depth_maps(dense, scene, threads=threads).values())
    if limits is not None:
        near, far = limits.T
        maps = [
            keep_depths(m, (m.depth >= near[m.view % len(near)]) & (m.depth <= far[m.view % len(far)]))
            for m in maps
        ]
    if not any(np.isfinite(one.depth).any() for one in maps):
        raise StageFailure.of("no-depth-in-range", counted(len(maps), "view"))
    return tuple(maps)


def confirmed_depth_maps(
    dense: DepthEstimator, scene: MultiViewScene, *, threads: int = 1
) -> dict[int, records.DepthMap]:
    """Depth maps of all views by number, confirmed by each other; the result does not depend on threads."""
    order = sorted(scene.views)
    with ThreadPool(threads) as pool:
        each = pool.map(lambda i: dense.depth_map(scene, i, pool=pool), order)
        found = dict(zip(order, each, strict=True))
        return dict(zip(order, pool.map(lambda i: dense.confirm(scene, found, i), order), strict=True))


@one_blas_thread()
def fuse_depth_maps(
    depth_maps: Sequence[records.DepthMap] | Sequence[F32 | F64], cameras: CameraInput | None = None, *,
    sizes: I64 | None = None, config: Config | None = None, threads: int = 1,
) -> records.TexturedMesh:  # fmt: skip
    """Fuse depth maps to one surface (2.6; Curless and Levoy, SIGGRAPH 1996).

    Parameters
    ----------
    depth_maps : sequence of DepthMap or ndarray (H, W)
        Result of :func:`depth_maps`; or plain depths z in the camera frame, NaN or infinite where unknown, of
        images without distortion, whose standard deviation is taken as the size of a pixel.
    cameras, sizes : sequence of Camera, tuple (K, R, t) or Reconstruction, array_like
        For plain depths: their cameras; for maps of another size they are scaled, (x + 0.5) s - 0.5.
    config, threads : PipelineConfig, str or Path, int
        ``config.model`` is the method; number of threads, on which the result does not depend.

    Returns
    -------
    TexturedMesh
        Vertices and faces without colours, for :func:`texture`.

    Raises
    ------
    ValueError, UsageError, StageFailure
        If depths and cameras do not fit together; if ``config.model`` has another kind; if there is no depth.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import Camera, fuse_depth_maps
    >>> K = np.array([[100.0, 0, 49.5], [0, 100, 49.5], [0, 0, 1]])
    >>> mesh = fuse_depth_maps([np.full((100, 100), 2.0)], [Camera(K, np.eye(3), np.zeros(3), (100, 100))])
    >>> mesh.vertices[:, 2].round(2).min(), mesh.vertices[:, 2].round(2).max()
    (np.float64(2.0), np.float64(2.0))
    """
    depth_maps = _images.list_of_images("fuse_depth_maps", depth_maps, "a sequence of depth maps")
    if not depth_maps:
        raise ValueError("fuse_depth_maps needs at least one depth map; got none")
    model = as_config(config).model
    if not isinstance(model, SurfaceModel):
        raise UsageError(f"fuse_depth_maps needs a SurfaceModel as config.model; got {type(model).__name__}")
    if all(isinstance(one, records.DepthMap) for one in depth_maps):
        return model.surface_of(depth_maps, threads=threads)
    if cameras is None:
        raise ValueError("fuse_depth_maps needs the cameras of plain depths")
    views = as_cameras("fuse_depth_maps", cameras, sizes)
    if len(views) != len(depth_maps):
        raise ValueError(Notice("camera-per-depth-map", len(views), len(depth_maps)))
    given = enumerate(zip(depth_maps, views, strict=True))
    return model.surface_of([_plain(i, depth, view) for i, (depth, view) in given], threads=threads)


@one_blas_thread()
def texture(
    mesh: records.TexturedMesh, images: ImagesInput, cameras: CameraInput, *, sizes: I64 | None = None,
    max_size: int | None = None, config: Config | None = None, threads: int = 1,
) -> records.TexturedMesh:  # fmt: skip
    """Texture a surface from images with known cameras (2.6).

    Parameters
    ----------
    mesh : TexturedMesh
        Vertices and faces; faces anticlockwise seen from the cameras. Faces that no image shows completely
        take the colours of their surroundings, so large ones must be subdivided.
    images, cameras, sizes, max_size, config, threads
        As for :func:`depth_maps`; ``config.model`` is the method.

    Returns
    -------
    TexturedMesh
        For :func:`thesisrecon.render` and :func:`thesisrecon.write_mesh`.

    Raises
    ------
    ValueError, StageFailure
        If the mesh is invalid; if a camera is missing or is not of its image's size; if no view shows a face
        completely.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import Camera, TexturedMesh, texture
    >>> square = np.array([[-1.0, -1, 4], [1, -1, 4], [1, 1, 4], [-1, 1, 4]])
    >>> mesh = TexturedMesh(square, np.array([[0, 2, 1], [0, 3, 2]]))
    >>> K = np.array([[100.0, 0, 49.5], [0, 100, 49.5], [0, 0, 1]])
    >>> camera = Camera(K, np.eye(3), np.zeros(3), (100, 100))
    >>> image = np.zeros((100, 100, 3), np.uint8)
    >>> image[:50], image[50:] = (200, 0, 0), (0, 0, 200)
    >>> texture(mesh, [image], [camera]).texture.dtype
    dtype('uint8')
    """
    mesh = records.as_mesh("texture", mesh)
    method = as_config(config)
    read, model = _scene("texture", images, cameras, sizes, max_size or method.images.max_size_px)
    longest, n = max(max(image.size) for image in read), len(read)
    views = [pinhole_view(read[i % n], model, i, max_side=longest) for i in pinhole_numbers(model)]
    return method.model.color(mesh, views, threads=threads)


def _scene(
    caller: str, images: ImagesInput, cameras: CameraInput, sizes: I64 | None, max_size: int
) -> tuple[list[records.Image], records.Reconstruction]:
    """Images at working size, and their cameras for it, with the points of a reconstruction."""
    cameras = named_cameras(cameras)
    if isinstance(images, str | Path):
        files = _images.files_by_name(images)
        # Images that were not registered have no camera.
        files = {n: f for n, f in files.items() if isinstance(cameras, Mapping) and n in cameras} or files
        names, listed = list(files), [Path(file) for file in files.values()]
    else:
        listed = _images.eight_bit_images(*_images.list_of_images(caller, images))
        names = [_name_of(n, image) for n, image in enumerate(listed)]
    views = as_cameras(caller, cameras, sizes, names)
    if len(views) != len(names):
        raise ValueError(f"{caller} needs a camera per image; got {len(views)} and {len(names)}")
    read = [
        _images.read_image(one, max_size_px=max_size, as_stored=view.as_stored).images[0]
        for one, view in zip(listed, views, strict=True)
    ]
    scaled = []
    for name, image, view in zip(names, read, views, strict=True):
        if image.original_size != view.size:
            words = _images.rotation_words(view.as_stored)
            raise ValueError(Notice("camera-of-another-size", name, image.original_size, view.size, words))
        scaled.append(_scaled(view, image.scale, image.size))
    model = _model(scaled)
    if isinstance(cameras, records.Reconstruction) and len(cameras.tracks.xy):
        t, kept = cameras.tracks, cameras.registered[cameras.tracks.view_index]
        index = (np.cumsum(cameras.registered) - 1)[t.view_index[kept]]
        xy = (t.xy[kept] + 0.5) * np.array([image.scale for image in read])[index, None] - 0.5
        tracks = records.Tracks(index, t.point_index[kept], xy, len(read), t.n_points)
        model = replace(model, X=cameras.X, valid=cameras.valid, inlier=cameras.inlier[kept], tracks=tracks)
    return read, model


def _name_of(number: int, image: ImageInput) -> str:
    if isinstance(image, str | Path):
        return Path(image).name
    return image.name if isinstance(image, records.Image) else f"image-{number}"


def _scaled(camera: Camera, scale: float, size: tuple[int, int]) -> Camera:
    """The camera of an image reduced by one scale along both axes."""
    return replace(camera, K=resizing_transform(scale) @ camera.K, size=size)


def _model(views: Sequence[Camera]) -> records.Reconstruction:
    """The cameras without points."""
    n, lenses = len(views), stacked_rows([view.lens_row for view in views])
    none = np.zeros(0, dtype=np.int64)
    K, P = (np.array([getattr(view, name) for view in views]).reshape(n, 3, -1) for name in ("K", "P"))
    return records.Reconstruction(
        "metric", P, np.zeros((0, 4)), np.ones(n, dtype=bool), np.zeros(0, dtype=bool),
        np.zeros(0, dtype=bool), records.Tracks(none, none, np.zeros((0, 2)), n, 0),
        np.array([view.size for view in views]).reshape(n, 2), 1.0, ("",) * n, K, lenses,
    )  # fmt: skip


def _plain(number: int, depth: F32 | F64, camera: Camera) -> records.DepthMap:
    """The depth map of an array of the camera's size or smaller."""
    z: F32 = numbers("fuse_depth_maps", missing=("depth",), depth=depth)[0].astype(np.float32)
    # Renderers give infinity where no surface is.
    z[~((z > 0.0) & (z < np.inf))] = np.nan
    if z.ndim != 2 or not camera.is_pinhole:
        raise ValueError(f"plain depths need (H, W) and a camera without distortion; got {z.shape}")
    height, width = z.shape
    if abs(width / camera.size[0] - height / camera.size[1]) > 1.0 / min(camera.size):
        raise ValueError(Notice("camera-of-depth-map", number, width, height, camera.size))
    own = _scaled(camera, width / camera.size[0], (width, height))
    return records.DepthMap(number, own.P, z, z / np.float32(own.K[0, 0]), np.isfinite(z).astype(np.uint8))
