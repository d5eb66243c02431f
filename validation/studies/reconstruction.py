"""The main job against the truth and COLMAP: cameras registered, their errors, reprojection, wall time.

Every number is computed here from saved cameras and points; no summary of any method is believed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from thesisrecon.records import Reconstruction
from validation.metrics.cameras import (
    CameraErrors,
    Reprojection,
    TrueCameras,
    measure_cameras,
    measure_reprojection,
)
from validation.metrics.record import Metric

OURS, THESIS = "ours (default)", "ours (thesis)"
COLMAP, COLMAP_PP = "COLMAP", "COLMAP, principal point refined"

# Per scene: focal %, centre mm, median reprojection px. Every scene here must also register all its cameras.
TARGETS: dict[str, tuple[float | None, float | None, float | None]] = {
    "courtyard": (0.3, None, None),
    "fountain-P11": (0.5, 8.0, 0.35),
    "Herz-Jesus-P8": (0.5, 8.0, 0.35),
}
KERMIT_REGISTERED = 9
CLAIM_TOLERANCE_PCT = 1.0
TIMED_SCENES = ("fountain-P11", "Herz-Jesus-P8")


@dataclass(frozen=True)
class Outcome:
    """What one method made of one scene: ``reconstruction`` None where it failed, with the ``failure``.

    ``wall_s`` is the time that counts, ``seconds`` its parts, ``cpu_s`` the processor time of the whole
    process, which other work on the machine disturbs less; ``reasons`` maps the photographs that are not
    registered to the reason the method gave; ``claimed_rms_px`` is the reprojection the method itself states.
    """

    reconstruction: Reconstruction | None
    wall_s: float
    peak_mb: float
    cpu_s: float
    seconds: Mapping[str, float] = field(default_factory=dict)
    failure: str = ""
    reasons: Mapping[str, str] = field(default_factory=dict)
    claimed_rms_px: float | None = None


def check_reconstruction(
    scene: str, n_views: int, truth: TrueCameras | None, outcomes: Mapping[str, Outcome]
) -> list[Metric]:
    """All rows of one scene; ``outcomes`` maps a method's name to what it made, truth may be None."""
    models = {name: outcome.reconstruction for name, outcome in outcomes.items()}
    focal, centre, reprojection = TARGETS.get(scene, (None, None, None))
    errors = {name: _errors(model, truth) for name, model in models.items()}
    residuals = {name: _residuals(model) for name, model in models.items()}

    def of_errors(read: Callable[[CameraErrors], float | None]) -> dict[str, float | None]:
        return {name: None if error is None else read(error) for name, error in errors.items()}

    def of_residuals(read: Callable[[Reprojection], float]) -> dict[str, float | None]:
        return {name: None if residual is None else read(residual) for name, residual in residuals.items()}

    rows = [_registered(scene, n_views, outcomes)]
    if truth is not None:
        rows += [
            Metric(scene, "focal error", "%", of_errors(lambda e: e.focal_error_pct), OURS, focal),
            Metric(
                scene, "principal point error", "px", of_errors(lambda e: e.principal_point_error_px), OURS
            ),
            Metric(scene, "mean camera-centre error", "mm", of_errors(_centre_mm), OURS, centre),
            Metric(scene, "median rotation error", "deg", of_errors(lambda e: e.rotation_error_deg), OURS),
        ]
    rows += [
        Metric(scene, "median reprojection", "px", of_residuals(lambda r: r.median_px), OURS, reprojection),
        Metric(scene, "mean reprojection", "px", of_residuals(lambda r: r.mean_px), OURS),
        Metric(scene, "points", "", {name: _points(model) for name, model in models.items()}, OURS),
        Metric(scene, "observations", "", of_residuals(lambda r: float(r.observations)), OURS),
        _wall_time(scene, outcomes),
        Metric(scene, "rms it claims off by", "%", _claims(outcomes, residuals), OURS, CLAIM_TOLERANCE_PCT),
        Metric(
            scene, "processor time", "s", {name: outcome.cpu_s for name, outcome in outcomes.items()}, OURS
        ),
        Metric(
            scene, "peak memory", "MB", {name: outcome.peak_mb for name, outcome in outcomes.items()}, OURS
        ),
    ]
    return rows


def _errors(model: Reconstruction | None, truth: TrueCameras | None) -> CameraErrors | None:
    return None if model is None or truth is None else measure_cameras(model, truth)


def _residuals(model: Reconstruction | None) -> Reprojection | None:
    return None if model is None else measure_reprojection(model)


def _centre_mm(errors: CameraErrors) -> float | None:
    return None if errors.centre_error is None else 1000.0 * errors.centre_error


def _points(model: Reconstruction | None) -> float | None:
    return None if model is None else float(model.valid.sum())


def _registered(scene: str, n_views: int, outcomes: Mapping[str, Outcome]) -> Metric:
    """All cameras where a scene has targets; kermit asks for 9, or a reason for each that is missing."""
    values = {
        name: 0.0 if o.reconstruction is None else float(o.reconstruction.registered.sum())
        for name, o in outcomes.items()
    }
    if scene != "kermit":
        target = float(n_views) if scene in TARGETS else None
        return Metric(scene, f"cameras registered of {n_views}", "", values, OURS, target, at_most=False)
    ours = outcomes[OURS]
    missing = n_views - int(values[OURS])
    explained = missing > n_views - KERMIT_REGISTERED and sum(map(bool, ours.reasons.values())) == missing
    target = 0.0 if explained else float(KERMIT_REGISTERED)
    note = f"{missing} missing, each with its reason" if explained else ""
    return Metric(
        scene, f"cameras registered of {n_views}", "", values, OURS, target, at_most=False, note=note
    )


def _claims(
    outcomes: Mapping[str, Outcome], residuals: Mapping[str, Reprojection | None]
) -> dict[str, float | None]:
    """How far the RMS that a method states is from the one recomputed from what it saved."""
    differences: dict[str, float | None] = {}
    for name, outcome in outcomes.items():
        measured, claimed = residuals[name], outcome.claimed_rms_px
        if measured is not None and claimed is not None:
            differences[name] = 100.0 * abs(claimed / measured.rms_px - 1.0)
    return differences


def _wall_time(scene: str, outcomes: Mapping[str, Outcome]) -> Metric:
    values: dict[str, float | None] = {name: outcome.wall_s for name, outcome in outcomes.items()}
    target = values.get(COLMAP) if scene in TIMED_SCENES else None
    return Metric(scene, "wall time", "s", values, OURS, target)
