"""Input of the report, reprojection residuals, and ``summary.json`` in pixels of the original images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesisrecon import records
from thesisrecon.arrays import F32, F64, U8, rows_of_views
from thesisrecon.camera import Camera
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.lens import image_of_directions
from thesisrecon.results import RunResult, in_original_pixels, pose_deviations

MAX_PICTURED = 100
"""Maximum number of images with thumbnails on the page, evenly spread; a table lists the others."""


def pictured(images: int, most: int = MAX_PICTURED) -> list[int]:
    """Numbers of the images that the page shows: at most so many, evenly spread."""
    spread = np.rint(np.linspace(0, images - 1, min(images, most)))
    return [int(number) for number in np.unique(spread)]


@dataclass(frozen=True, eq=False)
class ReportData(RunResult):
    """Content of ``report.html``: the result of a run, and what only the page shows."""

    title: str = ""
    config_text: str = ""
    colors: U8 | None = None  # (N, 3) of the metric points, valid or not
    model: records.TexturedMesh | None = None  # 45,000 faces with 2048 x 2048 texels add about 2 MB
    depths: Mapping[int, F32] = field(default_factory=dict)  # by view; a long side of 400 px is enough
    until: str | None = None  # last stage that was requested, None = all
    end: StageFailure | None = None

    @classmethod
    def of(cls, result: RunResult, **more: Any) -> ReportData:
        """The content of a result with ``more``."""
        return cls(**{f.name: getattr(result, f.name) for f in fields(result)}, **more)

    @property
    def bent(self) -> Mapping[str, Camera]:
        """A camera by image name of each number of a camera whose lens bends lines, at most four."""
        numbers, found = dict[int, str](), {} if self.metric is None else self.cameras
        for image, number in zip(self.images, self.groups, strict=True):
            if image.name in found and not found[image.name].is_pinhole:
                numbers.setdefault(int(number), image.name)
        return {name: found[name] for name in [*numbers.values()][:4]}

    @property
    def unit_of_length(self) -> str:
        """A sentence about the frame and scale of the model."""
        world = self.summary.get("world", {})
        if "rms_m" in world:
            fit = f"{counted(world['used'], 'GPS position')} fit to {world['rms_m']:.2g} m (RMS)"
            return f"Lengths are metres, the axes east, north and up: {fit}."
        if any(found.source == records.GIVEN for view in self.original_intrinsics for found in view.values()):
            return "Lengths and axes are those of the cameras that were given."
        free = "Lengths have no absolute scale, which images alone do not determine."
        if "std_deg" in world:
            return f"{free} The z axis points up by vertical lines, to {world['std_deg']:.1g} degrees."
        return f"{free} The z axis points up by the level sides of the images." if world else free

    @property
    def original_intrinsics(self) -> tuple[Mapping[str, records.IntrinsicInterval], ...]:
        """Intrinsics of every view in original pixels; empty mappings if there are none."""
        if self.metric is None:
            return tuple({} for _ in self.images)
        return tuple(
            {name: in_original_pixels(name, interval, image.scale) for name, interval in view.items()}
            for view, image in zip(self.metric.intrinsics, self.images, strict=True)
        )


@dataclass(frozen=True)
class ResidualSummary:
    """Number, median, RMS and 95 % quantile of reprojection distances."""

    count: int
    median_px: float
    rms_px: float
    q95_px: float


def reprojection_distances(reconstruction: records.Reconstruction) -> list[F64]:
    """Residual lengths |observed - reprojected| (px) per view, empty if it is not registered."""
    r, poses = reconstruction, reconstruction.P.copy()
    used = np.flatnonzero(r.used)
    view, X = r.tracks.view_index[used], r.X[r.tracks.point_index[used]]
    if r.K is not None:
        poses[r.registered] = np.linalg.solve(r.K[r.registered], poses[r.registered])
    # The weight of a point is positive, so that directions beyond 90 degrees keep their side.
    x = np.einsum("kij,kj->ki", poses[view], X * np.where(X[:, 3:] < 0.0, -1.0, 1.0))
    distances = []
    for v, rows in enumerate(rows_of_views(view, len(r.P))):
        if r.K is None:
            xy = dehomogenize(x[rows])
        else:
            xy = image_of_directions(x[rows], 0.0 if r.distortion is None else r.distortion[v])
            xy = xy @ r.K[v, :2, :2].T + r.K[v, :2, 2]
        part = np.linalg.norm(r.tracks.xy[used[rows]] - xy, axis=1)
        distances.append(part[np.isfinite(part)])
    return distances


def summarize_distances(distances: F64) -> ResidualSummary | None:
    """Summarize distances (N,) in pixels; None without any."""
    if len(distances) == 0:
        return None
    median, q95 = np.quantile(distances, [0.5, 0.95])
    return ResidualSummary(len(distances), float(median), float(np.sqrt(np.mean(distances**2))), float(q95))


def _rms(distances: F64) -> float | None:
    return float(np.sqrt(np.mean(distances**2))) if len(distances) else None


def _median(distances: F64) -> float | None:
    return float(np.median(distances)) if len(distances) else None


def summarize(result: RunResult) -> dict[str, Any]:
    """Content of ``summary.json``, in original pixels; None for stages that did not run."""
    best = result.best_reconstruction
    working = reprojection_distances(best) if best is not None else [np.zeros(0) for _ in result.images]
    original = [d / image.scale for d, image in zip(working, result.images, strict=True)]
    everything = np.concatenate([np.zeros(0), *original])
    views = [_view_summary(result, best, i, distances) for i, distances in enumerate(original)]
    calibration, metric, pairs = result.calibration, result.metric, result.pair_choice
    start = None if calibration is None else calibration.identifiability
    returned = None if metric is None else metric.identifiability
    tested = returned or calibration
    accepted = [pair for pair in result.pairs if pair.accepted]
    return {
        "failure": result.failure or None,
        "stratum": best.stratum if best is not None else None,
        "images": len(result.images) + len(result.unread),
        "registered": int(best.registered.sum()) if best is not None else 0,
        "points": int(best.valid.sum()) if best is not None else 0,
        "observations": int(best.used.sum()) if best is not None else 0,
        "reprojection_rms_px": _rms(everything),
        "reprojection_median_px": _median(everything),
        "reprojection_median_working_px": _median(np.concatenate([np.zeros(0), *working])),
        "trusted": None if metric is None else metric.trusted,
        "failed_checks": [] if metric is None else list(metric.failed_checks),
        "limitations": [] if metric is None else list(metric.limitations),
        "identifiable": None if tested is None else tested.identifiable,
        "motion": _motion(returned or start),
        "self_calibration": _start(calibration),
        "self_check": {} if metric is None else dict(metric.self_check),
        "pairs": {
            "selection": None if pairs is None else pairs.how,
            "possible": len(result.images) * (len(result.images) - 1) // 2,
            "compared": None if pairs is None else pairs.compared,
            "matched": len(result.pairs),
            "accepted": len(accepted),
            "verified_matches": sum(pair.inliers for pair in accepted),
            "undetermined": sum(pair.undetermined for pair in accepted),
        },
        "depth_maps": _depth_maps(result),
        "model": _model(result),
        "cameras": views,
        "refused": [{"name": name, "reason": reason} for name, reason in result.refused.items()],
        "warnings": list(result.warnings),
    }


def _start(calibration: records.SelfCalibration | None) -> dict[str, Any] | None:
    """The report on the images in which self-calibration began, which may be a part of those returned."""
    if calibration is None:
        return None
    facts = {"images": int((calibration.K[:, 0, 0] > 0.0).sum()), "identifiable": calibration.identifiable}
    return facts | {"motion": _motion(calibration.identifiability)}


def _motion(found: records.IdentifiabilityReport | None) -> dict[str, Any] | None:
    if found is None:
        return None
    evidence = {"evidence": dict(found.evidence), "sentences": list(found.sentences)}
    return {"nearest_critical": found.motion, "critical": found.critical, **evidence}


def _depth_maps(result: RunResult) -> list[dict[str, Any]] | None:
    if not result.depth_maps:
        return None
    return [
        {
            "name": result.images[m.view % len(result.images)].name,
            "known_fraction": float(np.isfinite(m.depth).mean()),
            "median_std_rel": _median((m.std / m.depth)[np.isfinite(m.depth)].astype(np.float64)),
        }
        for m in result.depth_maps
    ]


def _model(result: RunResult) -> dict[str, Any] | None:
    mesh, held = result.mesh, result.held_out
    if mesh is None:
        return None
    compared = None
    if held is not None:
        compared = {
            "name": result.images[held.view].name,
            "psnr_db": held.psnr_db if np.isfinite(held.psnr_db) else None,
            "ssim": held.ssim,
            "compared_fraction": held.share,
        }
    return {
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "texture_px": None if mesh.texture is None else mesh.texture.shape[1::-1],
        "held_out": compared,
        "untextured_fraction": None if mesh.untextured is None else float(mesh.untextured.mean()),
    }


def _view_summary(
    result: RunResult, best: records.Reconstruction | None, i: int, distances: F64
) -> dict[str, Any]:
    image = result.images[i]
    registered = best is not None and bool(best.registered[i])
    view: dict[str, Any] = {
        "name": image.name, "registered": registered, "reason": result.refused.get(image.name, ""),
        "camera": int(result.groups[i]), "width_px": image.original_size[0],
        "height_px": image.original_size[1], "working_scale": image.scale,
        "corners": len(result.features[i].xy) if result.features else None, "observations": len(distances),
        "reprojection_rms_px": _rms(distances),
    }  # fmt: skip
    if image.mask is not None:
        view["masked_fraction"] = float(1.0 - image.mask.mean())
    if registered and result.metric is not None:
        for name, working in result.metric.intrinsics[i].items():
            interval = in_original_pixels(name, working, image.scale)
            view[name] = {"value": interval.value, "std": interval.std, "source": interval.source}
        view["pose_std"] = pose_deviations(result.metric, i)
    return view


def point_colors(
    reconstruction: records.Reconstruction, images: tuple[records.Image, ...]
) -> NDArray[np.uint8]:
    """Average colours (N, 3) of the observations of each point; mid-grey without observations."""
    tracks, used = reconstruction.tracks, reconstruction.used
    view, point = tracks.view_index[used], tracks.point_index[used]
    xy, colors = np.rint(tracks.xy[used]).astype(np.int64), np.zeros((len(view), 3))
    for image, rows in zip(images, rows_of_views(view, len(images)), strict=True):
        column, row = (np.clip(xy[rows, k], 0, image.size[k] - 1) for k in (0, 1))
        colors[rows] = image.rgb[row, column]
    n = len(reconstruction.X)
    total = np.stack([np.bincount(point, channel, minlength=n) for channel in colors.T], axis=1)
    count = np.bincount(point, minlength=len(total))
    total[count == 0] = 128.0
    return np.rint(total / np.maximum(count, 1)[:, None]).astype(np.uint8)
