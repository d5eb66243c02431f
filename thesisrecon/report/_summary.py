"""``summary.json`` and ``cameras.json``: the results of a run, in pixels of the original images."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F64
from thesisrecon.records import Image, Reconstruction, RunResult
from thesisrecon.report._data import in_original_pixels, reprojection_distances, used_observations


def summarize(result: RunResult) -> dict[str, Any]:
    """Content of ``summary.json`` without times and settings; None for stages that did not run.

    Lengths are in original pixels, (x + 0.5) / scale - 0.5; ``..._working_px`` are in pixels at working size.
    """
    best = result.metric.reconstruction if result.metric is not None else result.projective
    working = reprojection_distances(best) if best is not None else [np.zeros(0) for _ in result.images]
    original = [d / image.scale for d, image in zip(working, result.images, strict=True)]
    everything = np.concatenate([np.zeros(0), *original])
    views = [_view_summary(result, best, i, distances) for i, distances in enumerate(original)]
    return {
        "failure": result.failure or None,
        "stratum": best.stratum if best is not None else None,
        "images": len(result.images) + len(result.unread),
        "registered": int(best.registered.sum()) if best is not None else 0,
        "points": int(best.valid.sum()) if best is not None else 0,
        "observations": len(used_observations(best)) if best is not None else 0,
        "reprojection_rms_px": _rms(everything),
        "reprojection_median_px": _median(everything),
        "reprojection_median_working_px": _median(np.concatenate([np.zeros(0), *working])),
        "trusted": result.metric.trusted if result.metric is not None else None,
        "failed_checks": list(result.metric.failed_checks) if result.metric is not None else [],
        "identifiable": result.calibration.identifiable if result.calibration is not None else None,
        "motion": _motion(result),
        "self_check": dict(result.metric.self_check) if result.metric is not None else {},
        "pairs": {
            "selection": result.pair_choice.how if result.pair_choice is not None else None,
            "possible": len(result.images) * (len(result.images) - 1) // 2,
            "compared": result.pair_choice.compared if result.pair_choice is not None else None,
            "matched": len(result.pairs),
            "accepted": sum(pair.accepted for pair in result.pairs),
            "verified_matches": sum(pair.inliers for pair in result.pairs if pair.accepted),
            "undetermined": sum(pair.undetermined for pair in result.pairs if pair.accepted),
        },
        "depth_maps": _depth_maps(result),
        "model": _model(result),
        "cameras": views,
        "refused": [{"name": name, "reason": reason} for name, reason in result.refused.items()],
        "warnings": list(result.warnings),
    }


def _motion(result: RunResult) -> dict[str, Any] | None:
    """Return the nearest critical motion and its evidence."""
    identifiability = None if result.calibration is None else result.calibration.identifiability
    if identifiability is None:
        return None
    return {
        "nearest_critical": identifiability.motion,
        "critical": identifiability.critical,
        "evidence": dict(identifiability.evidence),
        "sentences": list(identifiability.sentences),
    }


def _depth_maps(result: RunResult) -> list[dict[str, Any]] | None:
    """Return coverage and precision of the depth maps; None if there are none."""
    if not result.depth_maps:
        return None
    return [
        {
            "name": result.images[m.view].name,
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
        "texture_px": None if mesh.texture is None else [mesh.texture.shape[1], mesh.texture.shape[0]],
        "held_out": compared,
        "untextured_fraction": None if mesh.untextured is None else float(mesh.untextured.mean()),
    }


def _view_summary(result: RunResult, best: Reconstruction | None, i: int, distances: F64) -> dict[str, Any]:
    image = result.images[i]
    registered = best is not None and bool(best.registered[i])
    view: dict[str, Any] = {
        "name": image.name,
        "registered": registered,
        "reason": result.refused.get(image.name, ""),
        "camera": int(result.groups[i]),
        "width_px": image.original_size[0],
        "height_px": image.original_size[1],
        "working_scale": image.scale,
        "corners": len(result.features[i].xy) if result.features else None,
        "observations": len(distances),
        "reprojection_rms_px": _rms(distances),
    }
    if registered and result.metric is not None:
        for name, working in result.metric.intrinsics[i].items():
            interval = in_original_pixels(name, working, image.scale)
            view[name] = {"value": interval.value, "std": interval.std, "source": interval.source}
    return view


def _rms(distances: F64) -> float | None:
    return float(np.sqrt(np.mean(distances**2))) if len(distances) else None


def _median(distances: F64) -> float | None:
    return float(np.median(distances)) if len(distances) else None


def point_colors(reconstruction: Reconstruction, images: tuple[Image, ...]) -> NDArray[np.uint8]:
    """Average colours (N, 3) of the observations of each point; mid-grey without observations."""
    used = used_observations(reconstruction)
    tracks = reconstruction.tracks
    view, point = tracks.view_index[used], tracks.point_index[used]
    xy = np.rint(tracks.xy[used]).astype(np.int64)
    total = np.zeros((len(reconstruction.X), 3))
    for i, image in enumerate(images):
        here = view == i
        column = np.clip(xy[here, 0], 0, image.size[0] - 1)
        row = np.clip(xy[here, 1], 0, image.size[1] - 1)
        np.add.at(total, point[here], image.rgb[row, column].astype(np.float64))
    count = np.bincount(point, minlength=len(total))
    total[count == 0] = 128.0
    return np.rint(total / np.maximum(count, 1)[:, None]).astype(np.uint8)
