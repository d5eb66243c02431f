"""Export of a model to other programs: the files they read, and images without lens distortion."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np

from thesisrecon._numba import ThreadPool
from thesisrecon.api.given import Model, as_sparse_model
from thesisrecon.arrays import B8, F64, I64, flag, rows_of_views
from thesisrecon.camera import viewing_rays
from thesisrecon.errors import Notice, UsageError, require_word
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.imaging.pinholes import FACES, WIDE, is_wide, seen_faces
from thesisrecon.imaging.resampling import undistort_image
from thesisrecon.io import _exports as formats
from thesisrecon.io import _images
from thesisrecon.io._colmap import COLMAP_FILES, has_skew, write_sparse_model
from thesisrecon.io._exports import write_image
from thesisrecon.io._files import as_path, first_repeated, read_json, require_image_name, write_atomically
from thesisrecon.io._meshes import glb_bytes
from thesisrecon.io._meshes import read_mesh as mesh_of_file
from thesisrecon.io._models import colmap_model_in
from thesisrecon.io._outputs import claim_folder
from thesisrecon.io._pixels import MemoryBudget
from thesisrecon.lens import directions_of_image, growing_radius, named_lens, undistort
from thesisrecon.records import TexturedMesh
from thesisrecon.results import RunResult, SparseModel, SparseView
from thesisrecon.runtime._executors import available_threads

# Separate from the budget for decoding, which each image needs while it occupies this one.
_budget = MemoryBudget(_images.MAX_DECODED_BYTES)
Images = str | Path | Mapping[str, str]
"""A folder of images, or their files by name."""


@dataclass(frozen=True)
class ExportReport:
    """Main file of an export, and remarks on it."""

    file: Path
    notes: tuple[str, ...] = ()


FARTHEST = 1e3  # tangent of the angle from the axis at which directions count as behind the camera
FORMATS = ("colmap-undistorted", "nerfstudio", "colmap")
"""All but the last have undistorted images, perhaps with masks."""


def export(
    model: Model, out: str | Path, *, to: str,
    images: Images | None = None, masks: str | Path | None = None, threads: int = 0,
    overwrite: bool = False,
) -> ExportReport:  # fmt: skip
    """Write a model for another program.

    Parameters
    ----------
    model : path, RunResult, SparseModel, Reconstruction, mapping of str to Camera or sequence of Camera
        As for :func:`thesisrecon.align_to_positions`.
    out : path
        Folder of the export; created if missing.
    to : str
        ``"colmap-undistorted"`` and ``"nerfstudio"`` write undistorted images of pinhole cameras too, up to
        five of 90 x 90 degrees, with masks, of an image wider than 110 degrees; ``"colmap"`` keeps the
        distortion and needs no images, ``"nerfstudio"`` keeps it if all lenses are ``"fisheye"``.
    images : path or mapping of str to path, optional
        Folder of the original images, or their files by name; None: those that the run was made from. Those
        of a COLMAP model are used as stored, without EXIF rotation.
    masks : path, optional
        Folder of the masks of the original images; None: that of the run, if it had masks. Transparent pixels
        of the images are masked too.
    threads : int
        Number of images that are undistorted at the same time; 0: one per processor.
    overwrite : bool
        Replace files of the same names that thesisrecon did not write, or that were changed since.

    Returns
    -------
    ExportReport
        ``file``: the file or folder to open in the other program; ``notes``: differences from the model.

    Raises
    ------
    UsageError, StageFailure, OutputError
        If the format is unknown or cannot represent the cameras, the images are not found or have another
        size, or a file would be replaced; if an image cannot be read; if a file cannot be written.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np
    >>> from thesisrecon import export
    >>> from thesisrecon.results import SparseModel, SparseView
    >>> K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    >>> view = SparseView("a.jpg", np.eye(3), np.zeros(3), K, (640, 480), np.array([-0.1, 0, 0]))
    >>> with TemporaryDirectory() as folder:
    ...     report = export(SparseModel([view]), folder, to="colmap")
    >>> report.file.name
    '0'
    """
    require_word("export format", to, FORMATS)
    folder = as_path("export", "out", out)
    flag("export", "overwrite", overwrite)
    if images is None:
        images = recorded_images(model)
    elif not isinstance(images, Mapping):
        images = as_path("export", "images", images)
    lost: list[str] = []
    if masks is None:
        masks, lost = recorded_masks(model, to)
    else:
        masks = as_path("export", "masks", masks)
    source = model.out if isinstance(model, RunResult) else None
    source = Path(model) if isinstance(model, str | os.PathLike) else source
    require_separate(folder, to, model=source, images=images, masks=masks)
    model = as_sparse_model(model)
    _require_cameras(model, to)
    if os.path.lexists(folder / "run.json"):
        raise UsageError(f"the folder {folder} holds a run; export to another folder")
    sparse, nerfstudio = folder / "sparse" / "0", to == "nerfstudio"
    if to == "colmap":
        with claim_folder(folder, overwrite=overwrite, names=COLMAP_FILES):
            write_sparse_model(sparse, model)
            return ExportReport(sparse, tuple(lost))
    notes = lost + (_rounding_notes(model) if nerfstudio else [])
    undistorted, pinholes = _undistorted(model, keep_lens=nerfstudio and formats.is_fisheye(model))
    divided = any(pinhole.turn is not None for each in pinholes for pinhole in each)
    if divided:
        notes.append(Notice("divided-images", len(model.views), len(undistorted.views), WIDE))
    if images is None:
        raise UsageError(Notice("images-not-recorded"))
    paths = _images.find_images(images, model.names)
    may_mask = masks is not None or divided or any(map(_images.may_be_transparent, paths))
    found = {} if masks is None else _images.find_masks(Path(masks), model.names)[0]
    files = [*(("transforms.json", "points.ply") if nerfstudio else COLMAP_FILES)]
    for name in undistorted.names:
        files += [f"images/{name}", f"masks/{name}.png"] if may_mask else [f"images/{name}"]
    with claim_folder(folder, overwrite=overwrite, names=files):
        has_mask = _write_images(folder, model, pinholes, paths, found, threads)
        masked = masks is not None or any(has_mask)
        notes += [_images.USELESS_MASKS] if masked and not any(has_mask) else []
        # Programs want a mask for every image or for none.
        for view, there in zip(undistorted.views, has_mask, strict=True):
            if masked and not there:
                _write_mask(folder, view.name, np.ones(view.intrinsics[1][::-1], dtype=bool))
        if nerfstudio:
            return ExportReport(formats.write_nerfstudio(folder, undistorted, masked=masked), tuple(notes))
        write_sparse_model(sparse, undistorted, pinhole=True)
        return ExportReport(sparse, tuple(notes))


def _write_mask(folder: Path, name: str, used: B8) -> None:
    write_image(folder / "masks" / f"{name}.png", np.where(used, 255, 0).astype(np.uint8))


def require_separate(
    folder: Path, to: str, *, model: str | Path | None = None, images: Images | None = None,
    masks: str | Path | None = None,
) -> None:  # fmt: skip
    """Raise ``UsageError`` if an export would replace the model, images or masks that it reads."""
    written = [folder / "images", folder / "masks"] if to != "colmap" else []
    written += [folder / "sparse" / "0"] if to.startswith("colmap") else []
    colmap = None if model is None else colmap_model_in(Path(model))
    places = images.values() if isinstance(images, Mapping) else [images]
    given = [Path(path) for path in (colmap, masks, *places) if path is not None]
    there = [path for path in written if path.exists()]
    lost = next((path for path in given if path.exists() and any(map(path.samefile, there))), None)
    if lost is not None:
        raise UsageError(Notice("export-over-originals", folder, lost))


def _require_cameras(model: SparseModel, to: str) -> None:
    """Require views with intrinsics that the format can hold."""
    if not model.views:
        raise UsageError("the model has no camera; there is nothing to export")
    for view in model.views:
        require_image_name(view.name, "the model")
        if view.K is None or view.size is None:
            raise UsageError(f"image {view.name} has no intrinsics or no size, which every export needs")
        if view.distortion is None:
            raise UsageError(f"the lens model of image {view.name} is unknown; it cannot be exported")
        if to == "colmap" and has_skew(view.K):
            raise UsageError(Notice("export-with-skew", to, view.name))


def _rounding_notes(model: SparseModel) -> list[str]:
    """A note on coordinates far from the origin, which files in single precision round."""
    if len(model.X) < 2:
        return []
    rounding = float(np.spacing(np.float32(np.abs(model.X).max())))
    small = rounding <= 1e-4 * float(np.median(np.ptp(model.X, axis=0)))
    return [] if small else [Notice("single-precision", rounding)]


def recorded_masks(model: Model, to: str) -> tuple[Path | None, list[str]]:
    """Return the folder of the masks of a run for formats with images, or a note that it is gone."""
    folder = recorded(model, "masks_folder") if to != "colmap" else None
    if folder is None or folder.is_dir():
        return folder, []
    return None, [f"no masks are written: the folder {folder} of the run is gone; give --masks (masks=)"]


def recorded_images(model: Model) -> Images | None:
    """Return the folder of the images of a run, or their files by name; None if they are not known."""
    folder, elsewhere = recorded(model, "images_folder"), _summary(model).get("images_elsewhere")
    if folder is None or not elsewhere:
        return folder
    return _images.files_by_name(folder) | dict(elsewhere)


def recorded(model: Model, name: str) -> Path | None:
    """Return a folder that the summary of a run names, such as "images_folder"; None if it is not known."""
    folder = _summary(model).get(name)
    return Path(folder) if isinstance(folder, str) else None


def _summary(model: Model) -> Mapping[str, Any]:
    if not isinstance(model, RunResult | str | os.PathLike):
        return {}
    summary = model.summary if isinstance(model, RunResult) else read_json(Path(model) / "summary.json")
    return summary if isinstance(summary, Mapping) else {}


class _Pinhole(NamedTuple):
    """A pinhole view of an image, and its rotation from the axes of the image if it is one of several."""

    view: SparseView
    turn: F64 | None


def _undistorted(model: SparseModel, *, keep_lens: bool = False) -> tuple[SparseModel, list[list[_Pinhole]]]:
    """The model with pinhole views, observations in their pixels, and names of files that can be written.

    Also the same views by image. With ``keep_lens`` only the names differ from those of the model.
    """
    frames: dict[tuple[bytes, bytes, object], tuple[F64, tuple[int, int]]] = {}
    views, xy, view_index = list[SparseView](), model.xy.copy(), model.view_index.copy()
    pinholes = list[list[_Pinhole]]()
    rows = rows_of_views(model.view_index, len(model.views))
    for i, view in enumerate(model.views):
        K, size, distortion = view.intrinsics
        if keep_lens:
            views.append(replace(view, name=_file_name(view.name)))
            pinholes.append([_Pinhole(views[-1], None)])
            continue
        if is_wide(K, size, distortion):
            faces = _faces(view)
            xy[rows[i]], number = _in_faces(view, faces, xy[rows[i]])
            view_index[rows[i]] = len(views) + number
            views += faces.values()
            pinholes.append([_Pinhole(face, FACES[name]) for name, face in faces.items()])
            continue
        key = (K.tobytes(), distortion.tobytes(), size)
        if key not in frames:
            frames[key] = _pinhole_frame(view)
        K, size = frames[key]
        here, name = rows[i], _file_name(view.name)
        xy[here] = _normalized(view, xy[here]) @ K[:2, :2].T + K[:2, 2]
        view_index[here] = len(views)
        views.append(replace(view, name=name, K=K, size=size, distortion=np.zeros(3)))
        pinholes.append([_Pinhole(views[-1], None)])
    if (twice := first_repeated((view.name for view in views), as_files=True)) is not None:
        raise UsageError(Notice("exported-twice", twice))
    return replace(model, views=views, xy=xy, view_index=view_index), pinholes


def _faces(view: SparseView) -> dict[str, SparseView]:
    """The pinhole views of 90 x 90 degrees of a wide view of which enough is seen, by name."""
    K, side, shown = seen_faces(*view.intrinsics)
    path, answer = PurePath(_file_name(view.name)), dict[str, SparseView]()
    for name in shown:
        turn, file = FACES[name], path.with_stem(f"{path.stem}_{name}").as_posix()
        answer[name] = replace(
            view, name=file, R=turn @ view.R, t=turn @ view.t, K=K, size=(side, side),
            distortion=np.zeros(3), std=None,
        )  # fmt: skip
    return answer


def _in_faces(view: SparseView, faces: Mapping[str, SparseView], xy: F64) -> tuple[F64, I64]:
    """Pixels (N, 2) of a wide view in the face that looks most in their direction, and its number (N,)."""
    K, _, lens = view.intrinsics
    rays = np.nan_to_num(viewing_rays(K, xy, lens), nan=1.0)
    turns = np.stack([FACES[name] for name in faces])
    face = np.argmax(rays @ turns[:, 2].T, axis=1)
    turned = np.einsum("nab,nb->na", turns[face], rays)
    own = next(iter(faces.values())).intrinsics[0]
    return dehomogenize(turned @ own.T), face


def _file_name(name: str) -> str:
    """Relative name of a JPEG or PNG file."""
    path = PurePath(name)
    return path.as_posix() if path.suffix.lower() in (".jpg", ".jpeg", ".png") else f"{path.as_posix()}.png"


def _normalized(view: SparseView, xy: F64) -> F64:
    """Undistorted normalised points (N, 2) of pixels; far outside where there is none."""
    K, _, distortion = view.intrinsics
    places = dehomogenize(homogenize(xy) @ np.linalg.inv(K).T)
    if named_lens(distortion)[0] == "radial":
        return undistort(places, distortion)
    rays = directions_of_image(places, distortion)
    with np.errstate(invalid="ignore"):
        ahead = rays[:, 2] > 1.0 / FARTHEST
        plane = dehomogenize(np.where(ahead[:, None], rays, 1.0))
        outside = places * (FARTHEST / np.maximum(np.linalg.norm(places, axis=1, keepdims=True), 1e-300))
    return np.where(ahead[:, None], plane, outside)


def _pinhole_frame(view: SparseView) -> tuple[F64, tuple[int, int]]:
    """K of the same focal lengths, without skew, and size of the largest pinhole image in the original."""
    original, sides, distortion = view.intrinsics
    x, y = (np.arange(float(side)) for side in sides)
    borders = [(np.full_like(y, side), y) for side in (0.0, x[-1])]
    borders += [(x, np.full_like(x, side)) for side in (0.0, y[-1])]
    left, right, top, bottom = (_normalized(view, np.column_stack(border)) for border in borders)
    focal = np.array([original[0, 0], original[1, 1]])
    low, high = focal * [left[:, 0].max(), top[:, 1].max()], focal * [right[:, 0].min(), bottom[:, 1].min()]
    corner = float(np.hypot(*(np.maximum(-low, high) / focal)))
    inner = min(1.0, 0.99 * growing_radius(distortion) / corner)
    low, high, K = low * inner, high * inner, np.diag([*focal, 1.0])
    # The image extends beyond the original by at most half of each side.
    growth, rounding_px = 0.5 * np.array(sides), 1e-6
    centre = original[:2, 2]
    first = np.ceil(np.maximum(low + centre, -growth) - rounding_px)
    last = np.floor(np.minimum(high + centre, np.array(sides) - 1 + growth) + rounding_px)
    size = (last - first).astype(np.int64) + 1
    K[:2, 2] = centre - first
    if not (np.isfinite(K).all() and size.min() >= 16):
        k = ", ".join(f"{value:.3g}" for value in distortion)
        raise UsageError(Notice("implausible-pinhole", view.name, *size, k, *original[:2, 2]))
    return K, (int(size[0]), int(size[1]))


def _write_images(
    folder: Path, model: SparseModel, pinholes: Sequence[Sequence[_Pinhole]], paths: Sequence[Path],
    masks: Mapping[str, Path], threads: int,
) -> list[bool]:  # fmt: skip
    """Write the pinhole images of a model's images into a folder, and their masks; return which have one."""
    whole = int(np.iinfo(np.int32).max)

    def write(i: int) -> list[bool]:
        K, size, distortion = model.views[i].intrinsics
        written = math.prod(pinholes[i][0].view.intrinsics[1])
        # Measured: 17 bytes per pixel of the original and of the result.
        with _budget.reserve(17 * (math.prod(size) + written)):
            (image,) = _images.read_image(paths[i], max_size_px=whole, as_stored=model.as_stored).images
            if image.size != size:
                rule = _images.rotation_words(model.as_stored)
                sizes = f"{image.size} pixels {rule}, but {size} (width, height) in the model"
                raise UsageError(f"{paths[i]} has {sizes}; give the images of the model")
            mask, file = image.mask, masks.get(model.names[i])
            if file is not None:
                mask = _images.read_mask(file, image, as_stored=model.as_stored)
            for pinhole in pinholes[i]:
                rgb, used = image.rgb, mask
                pinhole_K, pinhole_size, lens = pinhole.view.intrinsics
                bent = distortion.any() and not np.array_equal(distortion, lens)
                if bent or size != pinhole_size or not np.array_equal(K, pinhole_K):
                    frames = K, distortion, pinhole_K, pinhole_size
                    rgb, seen = undistort_image(rgb, *frames, turn=pinhole.turn)
                    used = seen if pinhole.turn is not None else None
                    if mask is not None:
                        levels = mask[:, :, None].astype(np.uint8)
                        _, used = undistort_image(levels, *frames, mask=mask, turn=pinhole.turn)
                write_image(folder / "images" / pinhole.view.name, rgb)
                if used is not None:
                    _write_mask(folder, pinhole.view.name, used)
            return [mask is not None or pinhole.turn is not None for pinhole in pinholes[i]]

    with ThreadPool(threads or available_threads()) as pool:
        return [there for each in pool.map(write, range(len(paths))) for there in each]


def write_mesh(path: str | Path, mesh: TexturedMesh) -> None:
    """Write a mesh as GLB, with its texture, or its vertex colours if it has none, and float32 coordinates.

    Parameters
    ----------
    path, mesh : str or Path, TexturedMesh
        File, which is replaced, and mesh. It is rotated by 180 degrees about x, since the y axis of glTF
        points up and that of cameras down.

    Raises
    ------
    ValueError, UsageError, OutputError
        If the mesh is invalid or no TexturedMesh; the name does not end in .glb; the file cannot be written.

    Examples
    --------
    >>> import numpy as np, tempfile
    >>> from thesisrecon import TexturedMesh, write_mesh
    >>> mesh = TexturedMesh(np.array([[-1.0, -1, 2], [1, -1, 2], [0, 1, 2]]), np.array([[0, 1, 2]]))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_mesh(folder + "/triangle.glb", mesh)
    """
    path = as_path("write_mesh", "path", path)
    if path.suffix.lower() != ".glb":
        raise UsageError(f"write_mesh writes GLB; give {path.name} the ending .glb")
    write_atomically(path, glb_bytes(mesh))


def read_mesh(path: str | Path) -> TexturedMesh:
    """Read a mesh with its texture or vertex colours.

    Parameters
    ----------
    path : str or Path
        A GLB of :func:`write_mesh` or of a run, whose axes are turned back, or a PLY or OBJ (with its MTL and
        texture), whose axes stay. Polygons become triangles.

    Returns
    -------
    TexturedMesh
        For :func:`thesisrecon.render`, :func:`thesisrecon.texture` and :func:`write_mesh`.

    Raises
    ------
    UsageError
        If there is no such file, it is damaged or of another kind, or holds no surface.

    Examples
    --------
    >>> import numpy as np, tempfile
    >>> from thesisrecon import TexturedMesh, read_mesh, write_mesh
    >>> mesh = TexturedMesh(np.array([[-1.0, -1, 2], [1, -1, 2], [0, 1, 2]]), np.array([[0, 1, 2]]))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_mesh(folder + "/triangle.glb", mesh)
    ...     read_mesh(folder + "/triangle.glb").vertices.tolist()
    [[-1.0, -1.0, 2.0], [1.0, -1.0, 2.0], [0.0, 1.0, 2.0]]
    """
    return mesh_of_file(as_path("read_mesh", "path", path))
