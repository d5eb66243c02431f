"""New views: interpolated between two images (1.2), by the trilinear tensor (1.3), rendered from a model."""

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from thesisrecon import arrays
from thesisrecon.api.pairs import match_pair
from thesisrecon.arrays import F32, F64, U8
from thesisrecon.camera import Camera
from thesisrecon.config import PipelineConfig
from thesisrecon.config.intrinsics import prior_from_options
from thesisrecon.config.text import Config, as_config
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.geometry.camera_matrix import calibration_matrix
from thesisrecon.geometry.two_view import epipoles, require_parallax_of_matches
from thesisrecon.io._images import eight_bit_images, read_image, read_levels, read_pixels
from thesisrecon.records import DisparityMap, Image, RenderedView, TexturedMesh, TwoView, as_mesh
from thesisrecon.runtime._blas import one_blas_thread
from thesisrecon.stereo._postprocessing import match_both_sides
from thesisrecon.stereo.correspondence import brightness_gain
from thesisrecon.stereo.rectification import PlanarRectification
from thesisrecon.views import interpolation, tensor
from thesisrecon.views.render import render_mesh

_COARSE = 4  # Reduction at which the largest disparity of a rectified pair is searched, up to half its width
_SPARSE = 7  # Subsampling step of the pixels of which the exposures are compared


@one_blas_thread()
def interpolate_view(
    left: Any, right: Any, s: float, *,
    disparity: DisparityMap | F32 | tuple[F32 | DisparityMap, F32 | DisparityMap] | None = None,
    config: Config | None = None,
) -> U8:  # fmt: skip
    """Interpolate the view between two rectified images (thesis, section 1.2; Seitz and Dyer 1995).

    Parameters
    ----------
    left, right : str, Path or ndarray (H, W, 3) uint8
        Images of parallel cameras with corresponding rows.
    s : float
        Position on the baseline, from 0 (left image) to 1 (right image).
    disparity : ndarray (H, W), DisparityMap or tuple of both sides, optional
        Disparities of the left image, x_right = x_left - d, NaN = unknown; those of the right image add the
        regions that only it shows. Those of maps must agree with the other side unless their ``sigma_px`` is
        0, as that of arrays. None: matched by ``config.dense``.
    config : PipelineConfig, str or path, optional
        The default configuration if None.

    Returns
    -------
    ndarray (H, W, 3) uint8
        The view of a camera on the baseline, with an interpolated focal length. Near surfaces occlude far
        ones where the scene violates monotonicity; regions that neither image shows are filled from behind.

    Raises
    ------
    ValueError, UsageError, StageFailure
        If ``s`` is outside [0, 1], shapes differ, or a file does not exist or cannot be read.

    Notes
    -----
    For many views of one pair call :func:`prepare_rectified_pair` once.

    Examples
    --------
    >>> import numpy as np
    >>> import thesisrecon
    >>> left = np.arange(32 * 32 * 3, dtype=np.uint8).reshape(32, 32, 3)
    >>> view = thesisrecon.interpolate_view(left, left, 0.5, disparity=np.zeros((32, 32), np.float32))
    >>> np.array_equal(view, left)
    True
    """
    if not 0.0 <= arrays.number("interpolate_view", "s", s) <= 1.0:
        raise ValueError(f"s must be between 0 (left image) and 1 (right image); got {s}")
    return prepare_rectified_pair(left, right, disparity=disparity, config=config).view(s)


def prepare_rectified_pair(
    left: Any, right: Any, *,
    disparity: DisparityMap | F32 | tuple[F32 | DisparityMap, F32 | DisparityMap] | None = None,
    config: Config | None = None,
) -> interpolation.InterpolatedPair:  # fmt: skip
    """Prepare two rectified images for any number of views between them: ``view(s)`` interpolates.

    The arguments are those of :func:`interpolate_view`.
    """
    levels = read_levels(left, right)
    images = read_pixels(left, right)
    shapes = [image.shape[:2] for image in images]
    if shapes[0] != shapes[1]:
        raise ValueError(f"rectified images must have the same size; got {shapes[0]} and {shapes[1]}")
    if disparity is None:
        config = as_config(config)
        most = _largest_disparity(levels[0], levels[1], config)
        maps = match_both_sides(
            partial(config.dense.match_rectified, max_disparity_px=most), levels[0], levels[1]
        )
    elif isinstance(disparity, tuple) and len(disparity) == 2:
        maps = _as_map(disparity[0]), _as_map(disparity[1])
    else:
        maps = _as_map(disparity), interpolation.disparity_of_right(_as_map(disparity))
    for shape in (found.disparity.shape for found in maps):
        if shape != shapes[0]:
            raise ValueError(f"disparities must have the shape of the images {shapes[0]}; got {shape}")
    # Exact disparities need not agree: one image may hide what the other one shows.
    exact = all(found.sigma_px == 0.0 for found in maps)
    fields = [found.disparity if exact else found.filled() for found in maps]
    left_xy, right_xy = _shifted(-fields[0]), _shifted(fields[1])
    y, x = (_SPARSE * at for at in np.nonzero(np.isfinite(maps[0].disparity[::_SPARSE, ::_SPARSE])))
    matches = np.stack([x, y], axis=1).astype(np.float64), left_xy[y, x].astype(np.float64)
    return interpolation.prepare_interpolation(
        (images[0], images[1]), np.stack([np.eye(3)] * 2), maps[0], (left_xy, right_xy),
        gain=brightness_gain(images[0], images[1], *matches),
        agree_px=np.inf if exact else tensor.AGREE_PX,
    )  # fmt: skip


def _shifted(by: F32) -> F32:
    """Positions (H, W, 2) of pixels moved along their rows, NaN where ``by`` is."""
    y, x = np.indices(by.shape, dtype=np.float32)
    return np.stack([x + by, y], axis=-1)


def _as_map(disparity: DisparityMap | F32) -> DisparityMap:
    """The disparities as a map; plain ones have confidence 1 where they are known."""
    if isinstance(disparity, DisparityMap):
        return disparity
    disparity = arrays.numbers("interpolate_view", missing=("disparity",), disparity=disparity)[0].astype(
        np.float32
    )
    if disparity.ndim != 2:
        raise ValueError(f"disparities must be (H, W), or a tuple of two such maps; got {disparity.shape}")
    return DisparityMap(disparity, np.isfinite(disparity).astype(np.float32), 0.0)


def _largest_disparity(left: U8 | F32, right: U8 | F32, config: PipelineConfig) -> float:
    """Estimate the largest disparity (px), with a margin, from the pair at a quarter of its size."""
    widest = 0.5 * float(left.shape[1])
    if min(left.shape[:2]) < 64:
        return widest
    found = config.dense.match_rectified(_reduced(left), _reduced(right), max_disparity_px=widest / _COARSE)
    sure = found.disparity[np.isfinite(found.disparity) & (found.confidence > 0.3)]
    if len(sure) == 0:
        return widest
    return min(widest, _COARSE * (1.05 * float(np.quantile(sure, 0.999)) + 2.0))


def _reduced(image: U8 | F32) -> F32:
    """Average blocks of ``_COARSE`` x ``_COARSE`` pixels; incomplete blocks are cut off."""
    height, width = (side // _COARSE for side in image.shape[:2])
    blocks = image[: _COARSE * height, : _COARSE * width].reshape(height, _COARSE, width, _COARSE, 3)
    return np.asarray(blocks.mean(axis=(1, 3)), dtype=np.float32)


def prepare_pair(
    image1: Any, image2: Any, *, config: Config | None = None, seed: int = 0
) -> interpolation.InterpolatedPair:
    """Match and rectify two images of any pose for views between them: ``view(s)`` interpolates.

    Sparse matching, F, rectification by homographies and dense matching in both directions (section 1.2;
    Seitz and Dyer, "View morphing", SIGGRAPH 1996). A ``StageFailure`` if the images do not match, show no
    parallax, are rolled against each other by more than 90 degrees, or the camera moved forwards (an epipole
    lies inside an image: its epipolar lines cannot become rows).
    """
    config = as_config(config)
    first, second = (
        one if isinstance(one, Image) else read_image(one, max_size_px=config.images.max_size_px).images[0]
        for one in eight_bit_images(image1, image2)
    )
    if first.size != second.size:
        sizes = " and ".join(f"{one.name} is {one.size[0]} x {one.size[1]}" for one in (first, second))
        raise UsageError(f"interpolation needs images of the same size; {sizes} px")
    if np.array_equal(first.rgb, second.rgb):
        raise UsageError(f"{first.name} and {second.name} are the same image; give different ones")
    pair = match_pair(first, second, config=config, seed=seed)
    _require_sideways_motion(pair, (first, second))
    try:
        dense = config.dense.match_two_views(first, second, pair.F, pair.xy1, pair.xy2, planar=True)
    except StageFailure as failure:
        if "polar" not in failure.advice:
            raise
        advice = "take the images side by side, not one behind the other"
        raise StageFailure(failure.reason, failure.evidence, advice) from None
    assert isinstance(dense.frame, PlanarRectification)
    # Halfway, views then show 0.7 of the field of view.
    if abs(roll := interpolation.roll_between(dense.frame.H, first.size)) > 90.0:
        raise StageFailure.of("rolled-images", abs(roll))
    images = first.rgb, second.rgb
    places = dense.correspondences(0, first.size), dense.correspondences(1, second.size)
    return interpolation.prepare_interpolation(images, dense.frame.H, dense.left, places, gain=dense.gain)


def _require_sideways_motion(pair: TwoView, images: tuple[Image, Image]) -> None:
    """Raise ``StageFailure`` if an epipole lies inside an image."""
    size = images[0].size
    for image, e in zip(images, epipoles(pair.F), strict=True):
        if abs(e[2]) * max(size) <= 1e-9 * np.hypot(e[0], e[1]):
            continue
        x, y = e[:2] / e[2]
        if -0.5 <= x <= size[0] - 0.5 and -0.5 <= y <= size[1] - 0.5:
            # Without parallax F is not unique, and neither are its epipoles.
            require_parallax_of_matches(pair.F, pair.xy1, pair.xy2)
            raise StageFailure.of("forward-motion", x, y, image.name)


def prepare_trilinear_views(
    image1: Any, image2: Any, *, K: ArrayLike | None = None, config: Config | None = None, seed: int = 0
) -> tensor.TensorSynthesis:
    """Match two images of any pose for views of any camera by the trilinear tensor (section 1.3).

    ``render(camera)`` of the result computes a view. K (3, 3) or (2, 3, 3) are the intrinsics in pixels of
    the given images. If None, the prior of ``config.intrinsics``; without a focal length there, a typical
    one: the views are then correct up to a projective transformation of space. A ``StageFailure`` if the
    images do not match, the matches contradict F, or no solution has the scene in front of both cameras.
    """
    config = as_config(config)
    size = config.images.max_size_px
    read = [read_image(one, max_size_px=size) for one in eight_bit_images(image1, image2)]
    first, second = (found.images[0] for found in read)
    K1, K2 = _intrinsics((first, second), [found.exif_focal_px[0] for found in read], K, config)
    found = match_pair(first, second, config=config, seed=seed)
    dense = config.dense.match_two_views(first, second, found.F, found.xy1, found.xy2)
    pair = tensor.pair_from_fundamental(found.F, found.xy1, found.xy2, K1=K1, K2=K2)
    places = dense.correspondences(0, first.size), dense.correspondences(1, second.size)
    return tensor.prepare_synthesis(pair, (first.rgb, second.rgb), places, gain=dense.gain)


@one_blas_thread()
def synthesize_view(
    image1: Any, image2: Any, rotation: ArrayLike, translation: ArrayLike, *, K: ArrayLike | None = None,
    config: Config | None = None, seed: int = 0,
) -> U8:  # fmt: skip
    """Compute the view of a virtual camera from two images by the trilinear tensor (section 1.3).

    Parameters
    ----------
    image1, image2 : str, Path or ndarray (H, W, 3) uint8
        The images.
    rotation, translation : array_like (3, 3) and (3,)
        Motion from the second camera to the virtual one, X_new = R X_2 + t (x right, y down, z forwards), in
        units of the distance between the two cameras. R = I and t = 0 reproduce the second image.
    K : array_like (3, 3) or (2, 3, 3), optional
        Intrinsics, as in :func:`prepare_trilinear_views`.
    config, seed : PipelineConfig or str or path, int
        Configuration (None: the default) and random seed of the matching.

    Returns
    -------
    ndarray (H, W, 3) uint8
        The view, with the working size and K of the second image.

    Raises
    ------
    StageFailure
        If the images cannot be read, do not match or show no parallax, or the camera does not see the scene.

    Notes
    -----
    For many views of one pair call ``prepare_trilinear_views`` once.

    Examples
    --------
    >>> import numpy as np
    >>> import thesisrecon
    >>> R, t = 2.0 * np.eye(3), np.zeros(3)
    >>> thesisrecon.synthesize_view("a.jpg", "b.jpg", R, t)
    Traceback (most recent call last):
        ...
    ValueError: view synthesis needs a rotation R; R'R deviates from the identity by 3
    """
    # Checked before the matching, which takes minutes.
    rotation, translation = arrays.numbers("synthesize_view", rotation=rotation, translation=translation)
    _given_intrinsics(K)
    tensor.VirtualCamera(rotation, translation, np.eye(3), (1, 1))
    views = prepare_trilinear_views(image1, image2, K=K, config=config, seed=seed)
    return views.render(tensor.VirtualCamera(rotation, translation, views.pair.K2, views.sizes[1]))


def _given_intrinsics(K: ArrayLike | None) -> F64 | None:
    """Return K as (2, 3, 3), None if not given; ``ValueError`` if it is not that of a camera."""
    if K is None:
        return None
    (given,) = arrays.numbers("view synthesis", K=K)
    if given.shape not in ((3, 3), (2, 3, 3)):
        raise ValueError(f"K must be (3, 3) for both images or (2, 3, 3); got {given.shape}")
    both = np.broadcast_to(given, (2, 3, 3))
    for one in both:
        arrays.require_calibration("view synthesis", one)
    return both


def _intrinsics(
    images: tuple[Image, Image], exif_focal_px: list[float], K: ArrayLike | None, config: PipelineConfig
) -> tuple[F64, F64]:
    """K of both images in pixels at working size: given, from the prior, or typical."""
    scales = np.array([image.scale for image in images])
    given = _given_intrinsics(K)
    if given is not None:
        first, second = map(arrays.resizing_transform, scales)
        return first @ given[0], second @ given[1]
    sizes = [image.original_size for image in images]
    prior = prior_from_options(config.intrinsics, sizes, np.array(exif_focal_px), scales).mean
    both = []
    for image, (f, aspect, skew, u, v, _) in zip(images, prior.tolist(), strict=True):
        f = f if np.isfinite(f) else float(tensor.default_intrinsics(image.size)[0, 0])
        both.append(calibration_matrix(f, aspect * f, u, v, skew=skew))
    return both[0], both[1]


def render(
    mesh: TexturedMesh, camera: Camera, *, background: tuple[int, int, int] = (0, 0, 0), samples: int = 2,
    threads: int = 1,
) -> RenderedView:  # fmt: skip
    """Render a mesh with a z-buffer, exact in perspective (section 2.6).

    Parameters
    ----------
    mesh, camera : TexturedMesh, Camera
        Mesh with a texture or vertex colours, shown as photographed, or neither (grey, lit from the camera),
        and camera with any lens, whose image has this lens.
    background : tuple of int, or of float
        Colour of empty pixels, 0 to 255, or 0 to 1 as floats.
    samples : int
        Samples per pixel side, averaged. Depth, z in the camera frame (below 0 beyond 90 degrees from the
        axis), and validity refer to the pixel centre.
    threads : int
        Number of threads; the image does not depend on it.

    Returns
    -------
    RenderedView

    Examples
    --------
    >>> triangle = TexturedMesh(np.array([[-1.0, -1, 2], [1, -1, 2], [0, 1, 2]]), np.array([[0, 1, 2]]))
    >>> K = np.array([[20.0, 0, 9.5], [0, 20, 9.5], [0, 0, 1]])
    >>> view = render(triangle, Camera(K, np.eye(3), np.zeros(3), (20, 20)))
    >>> view.color.shape, bool(view.valid[5, 10]), float(view.depth[5, 10])
    ((20, 20, 3), True, 2.0)
    """
    arrays.whole_number("render", "samples", samples, 1)
    arrays.whole_number("render", "threads", threads, 1)
    if not isinstance(camera, Camera):
        raise ValueError(f"render needs a thesisrecon.Camera as camera; got a {type(camera).__name__}")
    (behind,) = arrays.numbers("render", background=background)
    if behind.shape != (3,) or not np.isfinite(behind).all():
        rule = "background, three levels from 0 to 255 (or floats from 0 to 1)"
        raise ValueError(f"render needs {rule}; got {background!r}")
    colour = tuple(arrays.eight_bit(arrays.image_levels(background)[0])[0].tolist())
    mesh = as_mesh("render", mesh)
    return render_mesh(mesh, camera, background=colour, samples=samples, threads=threads)
