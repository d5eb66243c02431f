"""Algorithm 1 of the thesis, from photographs to metric cameras: the only place that composes stages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from thesisrecon.assumptions import assumptions_of_views
from thesisrecon.config import PipelineConfig, seeing
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.intake import check_pairs, empty_result, identity, read_set, wishes
from thesisrecon.io.images import ImageSource, PhotographSet, list_images, scene_name
from thesisrecon.outputs import RESULT_FILES, write_outputs
from thesisrecon.run import Progress, Run, RunOptions, start_run, stream
from thesisrecon.types import Assumptions, Features, Image, PairChoice, RunResult, SelfCalibration, TwoView

ATTEMPTS = 3
MIN_CORNERS = 16


def reconstruct(
    images: ImageSource,
    out: str | Path,
    *,
    config: PipelineConfig | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    **options: Unpack[RunOptions],
) -> RunResult:
    """Reconstruct metric cameras and points from photographs of one scene.

    Parameters
    ----------
    images : a folder, or a sequence of files, uint8 arrays (H, W) or (H, W, 3), or :class:`Image` records.
    out : the output folder; made where absent, resumed where it holds the same run.
    config : what runs; the preset ``default`` where None.
    seed : of all random steps, at least 0. The same photographs, config and seed give the same bytes,
        whatever the number of workers.
    progress : hears (stage, done, total) as parts of stages are done.
    **options : see :class:`RunOptions`.

    Returns
    -------
    RunResult : everything that was found, as it also stands in ``out``. The length unit of a reconstruction
        is free: photographs do not tell it.

    Raises
    ------
    UsageError : no such folder of photographs, no photographs in it, an output folder that cannot be
        written or holds another run.
    StageFailure : these photographs cannot be reconstructed. What was computed, the summary and the page are
        in ``out`` all the same.
    """
    until, run, overwrite = start_run(out, config or PipelineConfig(), seed, progress, options)
    if isinstance(images, str | Path):
        if not list_images(Path(images)):
            raise UsageError(f"there are no photographs in {images}")
        run.title = scene_name(Path(images)) or run.title
    # Reading photographs takes long: whether the folder is free for this run is asked before.
    with run.directory.claimed(wishes(run), overwrite=overwrite):
        photographs = read_set(run, images)
        check_pairs(run, photographs, until)
        run.directory.adopt(identity(run, photographs), overwrite=overwrite, results=RESULT_FILES)
        work = _Work(run, photographs, empty_result(run, photographs), until)
        try:
            work.check_photographs()
            for step in STEPS[until]:
                step(work)
        except StageFailure as failure:
            write_outputs(run, work.result, until=until, failure=failure)
            raise
        return write_outputs(run, work.result, until=until, failure=None)


@dataclass
class _Work:
    """What the steps of one run hand on: ``result`` grows, the rest is what they need beside it."""

    run: Run
    photographs: PhotographSet
    result: RunResult
    until: str
    prepared: dict[int, Any] | None = None

    @property
    def config(self) -> PipelineConfig:
        return self.run.config

    @property
    def assumed(self) -> Assumptions:
        """What the user lets us assume of the cameras."""
        scales = np.array([image.scale for image in self.result.images])
        sizes = [image.original_size for image in self.result.images]
        return assumptions_of_views(self.config.intrinsics, sizes, self.photographs.exif_focal_px, scales)

    def check_photographs(self) -> None:
        """Refuse what is too little before anything is computed."""
        found, needed = len(self.result.images), 1 if self.until == "features" else 2
        if found < needed:
            why = "; ".join(f"{name} {reason}" for name, reason in list(self.result.refused.items())[:3])
            raise StageFailure(
                f"{found or 'no'} usable photograph{'s' if found != 1 else ''}",
                f"at least {needed} different ones are needed{'; ' + why if why else ''}",
                "take more photographs of the scene from other places",
            )


# ---------------------------------------------------------------- 4.2.1: features


def _find_features(work: _Work) -> None:
    run, images = work.run, work.result.images
    variant = run.variant_key("features")
    keys = {
        f"{i:05d}": run.key("features", variant, photograph.digest)
        for i, photograph in enumerate(work.photographs.photographs)
    }
    features = run.kept_all(
        "features", keys, detect_features, lambda missing: [(work.config, images[i]) for i in missing]
    )
    work.result = replace(work.result, features=tuple(features))
    counts = [len(f.xy) for f in features]
    poor = [
        f"{image.name} has only {n} corners"
        for image, n in zip(images, counts, strict=True)
        if n < MIN_CORNERS
    ]
    run.finish(
        "features",
        counts={"images": len(images), "corners": sum(counts), "fewest_in_one_image": min(counts)},
        warnings=poor,
    )


def detect_features(config: PipelineConfig, image: Image) -> Features:
    return config.features.detect(image)


# ---------------------------------------------------------------- 4.2.2 and chapter 5: pairs of views


def _choose_pairs(work: _Work) -> None:
    run, images, features = work.run, work.result.images, work.result.features
    names = [image.name for image in images]
    key = run.key("pairs", run.variant_key("pairs"), names, run.logs["features"].keys, run.seed)
    run.progress("pairs", 0, 1)
    choice: PairChoice = run.kept(
        "pairs",
        "choice",
        key,
        lambda: work.config.pairs.select(
            names, features, map_all=run.workers.map_all, rng=stream(run.seed, "pairs")
        ),
    )
    work.result = replace(work.result, pair_choice=choice)
    possible = len(images) * (len(images) - 1) // 2
    counts = {"possible": possible, "compared": choice.compared, "chosen": len(choice.pairs)}
    run.finish("pairs", counts=counts)
    run.progress("pairs", 1, 1)


def _match_pairs(work: _Work) -> None:
    run, result = work.run, work.result
    assert result.pair_choice is not None
    pairs = [(int(i), int(j)) for i, j in result.pair_choice.pairs]
    variants = [run.variant_key(stage) for stage in ("matching", "epipolar", "verification")]
    features = list(run.logs["features"].keys.values())
    keys = {
        f"{i:05d}-{j:05d}": run.key("matches", variants, features[i], features[j], run.seed, i, j)
        for i, j in pairs
    }

    def arguments(missing: Sequence[int]) -> list[tuple[Any, ...]]:
        prepared = _prepared(work)
        return [
            (work.config, prepared[i], prepared[j], (i, j), run.seed) for i, j in (pairs[n] for n in missing)
        ]

    two_views: list[TwoView] = run.kept_all("matches", keys, match_views, arguments)
    work.result = replace(result, pairs=tuple(two_views))
    accepted = [pair for pair in two_views if pair.accepted]
    counts = {"pairs": len(pairs), "accepted": len(accepted), "verified": sum(p.inliers for p in accepted)}
    counts["undetermined"] = sum(pair.undetermined for pair in accepted)
    metrics = {"median_sigma_px": float(np.median([p.sigma_px for p in accepted]))} if accepted else {}
    run.finish("matches", counts=counts, metrics=metrics, warnings=_open_pairs(accepted))


def _open_pairs(accepted: Sequence[TwoView]) -> list[str]:
    """A sentence where the geometry of most pairs is open: what follows rests on few."""
    undetermined = [pair for pair in accepted if pair.undetermined]
    if 2 * len(undetermined) <= len(accepted):
        return []
    kinds = Counter(pair.configuration for pair in undetermined)
    told = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
    return [
        f"{len(undetermined)} of {len(accepted)} accepted pairs leave their epipolar geometry undetermined "
        f"({told})"
    ]


def _prepared(work: _Work) -> dict[int, Any]:
    """What matching needs of each view, made once and only when something must be computed from it."""
    if work.prepared is None:
        given = list(zip(work.result.images, work.result.features, strict=True))
        matching = work.config.matching
        work.prepared = dict(enumerate(work.run.workers.map_all(lambda view: matching.prepare(*view), given)))
    return work.prepared


def match_views(config: PipelineConfig, view1: Any, view2: Any, pair: tuple[int, int], seed: int) -> TwoView:
    """Match, estimate F, verify; a pair that cannot give an F is a refused pair, not an end of the run."""
    rng = stream(seed, "matches", *pair)
    candidates = 0
    try:
        matches = config.matching.match(
            view1, view2, pair=pair, estimate_fundamental=config.epipolar.estimate, rng=rng
        )
        candidates = len(matches.xy1)
        fit = config.epipolar.estimate(matches.xy1, matches.xy2, rng)
        return config.verification.verify(matches, fit, rng)
    except StageFailure as failure:
        return _refused_pair(pair, candidates, str(failure))


def _refused_pair(pair: tuple[int, int], candidates: int, reason: str) -> TwoView:
    nothing = np.zeros(0, dtype=np.int64)
    return TwoView(
        i=pair[0],
        j=pair[1],
        F=np.zeros((3, 3)),
        sigma_px=float("nan"),
        index1=nothing,
        index2=nothing,
        xy1=np.zeros((0, 2)),
        xy2=np.zeros((0, 2)),
        affine=np.zeros((0, 2, 2)),
        candidates=candidates,
        homography_share=float("nan"),
        accepted=False,
        reason=reason,
    )


def _build_tracks(work: _Work) -> None:
    run, result = work.run, work.result
    accepted = [pair for pair in result.pairs if pair.accepted]
    if not accepted:
        best = max(result.pairs, key=lambda pair: pair.inliers)
        raise StageFailure(
            "no two photographs could be matched",
            f"the best of {len(result.pairs)} pairs has {best.inliers} verified matches: {best.reason}",
            "take photographs with more overlap of a scene with texture, all of the same scene",
        )
    key = run.key("tracks", run.variant_key("tracks"), run.logs["matches"].keys, run.seed)
    tracks = run.kept(
        "tracks",
        "tracks",
        key,
        lambda: work.config.tracks.build(
            [_prepared(work)[i] for i in range(len(result.images))],
            result.pairs,
            stream(run.seed, "tracks"),
        ),
    )
    work.result = replace(result, tracks=tracks)
    seen = np.bincount(tracks.point_index, minlength=tracks.n_points)
    counts = {
        "points": tracks.n_points,
        "observations": len(tracks.xy),
        "seen_3_times": int((seen >= 3).sum()),
    }
    run.finish("tracks", counts=counts)


# ---------------------------------------------------------------- chapters 6 and 7, and the metric stage


def _reconstruct_projective(work: _Work, attempt: int = 0) -> None:
    run, result = work.run, work.result
    assert result.tracks is not None
    tracks, sizes = result.tracks, np.array([image.size for image in result.images], dtype=np.int64)
    key = run.key("projective", run.variant_key("projective"), run.logs["tracks"].keys, run.seed, attempt)
    run.progress("projective", 0, 1)
    projective = run.kept(
        "projective",
        f"attempt-{attempt}",
        key,
        lambda: work.config.projective.reconstruct(
            tracks, result.pairs, sizes, rng=stream(run.seed, "projective", attempt), attempt=attempt
        ),
    )
    work.result = replace(result, projective=projective)
    counts = {"registered": int(projective.registered.sum()), "points": int(projective.valid.sum())}
    run.finish("projective", counts=counts, metrics={"sigma_px": projective.sigma_px})
    run.progress("projective", 1, 1)


def _calibrate(work: _Work, attempt: int) -> None:
    run, assumed = work.run, work.assumed
    projective = work.result.projective
    assert projective is not None
    upstream = run.logs["projective"].keys[f"attempt-{attempt}"]
    wish = [assumed.shared, assumed.mean, assumed.std, assumed.alike]
    key = run.key("selfcalibration", run.variant_key("selfcalibration"), upstream, wish, run.seed)
    run.progress("selfcalibration", 0, 1)
    calibration = run.kept(
        "selfcalibration",
        f"attempt-{attempt}",
        key,
        lambda: seeing(work.config.selfcalibration, work.result.images).calibrate(
            projective,
            assumed=assumed,
            rng=stream(run.seed, "selfcalibration", attempt),
        ),
    )
    work.result = replace(work.result, calibration=calibration)
    counts = {"hypotheses": len(calibration.candidates), "identifiable": int(calibration.identifiable)}
    run.finish("selfcalibration", counts=counts, warnings=_critical(calibration))
    run.progress("selfcalibration", 1, 1)


def _critical(calibration: SelfCalibration) -> tuple[str, ...]:
    """What is to be said of a critical motion that the assumptions make good for; the rest is a doubt."""
    verdict = calibration.verdict
    if verdict is None or not (verdict.critical and verdict.identifiable):
        return ()
    return ("; ".join(verdict.sentences),)


def _refine(work: _Work, attempt: int) -> None:
    run, assumed = work.run, work.assumed
    projective, calibration = work.result.projective, work.result.calibration
    assert projective is not None
    assert calibration is not None
    upstream = run.logs["selfcalibration"].keys[f"attempt-{attempt}"]
    key = run.key("metric", run.variant_key("metric"), upstream, run.seed)
    run.progress("metric", 0, 1)
    metric = run.kept(
        "metric",
        f"attempt-{attempt}",
        key,
        lambda: work.config.metric.refine(
            projective,
            calibration,
            assumed=assumed,
            rng=stream(run.seed, "metric", attempt),
        ),
    )
    work.result = replace(work.result, metric=metric)
    best = metric.reconstruction
    counts = {"registered": int(best.registered.sum()), "points": int(best.valid.sum())}
    run.finish("metric", counts=counts, metrics={"sigma_px": best.sigma_px}, warnings=metric.warnings)
    run.progress("metric", 1, 1)


def _reconstruct_metric(work: _Work) -> None:
    """Projective, self-calibration, metric; where the self-check fails, again from another initial pair.

    Kept is the first result that is trusted; else the one with most cameras, then most points.
    """
    tried: list[RunResult] = []
    failures: list[StageFailure] = []
    start = work.result
    for attempt in range(ATTEMPTS):
        work.result = start
        try:
            _reconstruct_projective(work, attempt)
            _calibrate(work, attempt)
            _refine(work, attempt)
        except StageFailure as failure:
            failures.append(failure)
            tried.append(work.result)
            continue
        tried.append(work.result)
        if work.result.metric is not None and work.result.metric.trusted:
            break
    work.result = max(tried, key=_quality)
    if work.result.metric is None:
        raise failures[0]
    if len(tried) > 1:
        work.run.warnings.append(f"{len(tried)} initial pairs were tried; the best result was kept")


def _quality(result: RunResult) -> tuple[bool, bool, int, int]:
    best = result.metric.reconstruction if result.metric is not None else result.projective
    if best is None:
        return False, False, 0, 0
    trusted = result.metric is not None and result.metric.trusted
    return result.metric is not None, trusted, int(best.registered.sum()), int(best.valid.sum())


STEPS = {
    "features": (_find_features,),
    "matches": (_find_features, _choose_pairs, _match_pairs),
    "projective": (_find_features, _choose_pairs, _match_pairs, _build_tracks, _reconstruct_projective),
    "metric": (_find_features, _choose_pairs, _match_pairs, _build_tracks, _reconstruct_metric),
}
