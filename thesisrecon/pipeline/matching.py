"""The front end of Algorithm 1: features, pairs and matches of many images (chapters 4 and 5), and tracks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from thesisrecon._numba import code_digest
from thesisrecon.arrays import B8, F64, I64, rows_of_views
from thesisrecon.config import KINDS, PipelineConfig
from thesisrecon.config.plug_ins import FunctionMatcher, matches_of
from thesisrecon.epipolar.division import estimate_division
from thesisrecon.errors import Notice, StageFailure, counted
from thesisrecon.imaging.on_demand import RecentlyUsed
from thesisrecon.matching._prepared import select_found, strongest_corners, strongest_share
from thesisrecon.matching._seeds import seed_matches
from thesisrecon.matching.growth import SeedsAndGrowth
from thesisrecon.matching.pair_selection import (
    PairsOfAdded,
    connected_groups,
    pairs_to_connect,
    reject_repeated_structure,
)
from thesisrecon.matching.tracks import tracks_of_corners
from thesisrecon.optimize.bundle.projection import cached_pair_order
from thesisrecon.pipeline import lens
from thesisrecon.pipeline.large_sets import has_narrow_cut, tracks_of_part
from thesisrecon.pipeline.run import Batch, Job, Run, stream
from thesisrecon.records import Features, Image, Matches, PairChoice, Seeds, Tracks, TwoView

FEWER, FINAL = "-fewer", "final"
"""Suffix of the records of pairs matched with part of the corners, and name of the record of final pairs."""
MIN_VERIFIED = 240
"""Number of verified matches from part of the corners above which a pair is not matched again with all."""
MIN_GROUP = 3  # minimum number of images of a group that is reconstructed separately
CACHE_BYTES = 2**30
"""Prepared views take several times the memory of their image and are quickly prepared again."""
OBLIQUE_PAIRS = 64
"""Pairs of most overlap evidence that are matched with oblique views; as many again while one is accepted."""
MAX_BATCH, BATCHES_PER_WORKER, MAX_RESULT_BYTES = 64, 8, 2**25
"""Pairs of a batch, batches, and pickled bytes of the result of a batch, at most."""
PAIR_BYTES, MATCH_BYTES = 2**14, 80
"""Pickled bytes of a :class:`TwoView` without matches, at most, and of each match."""
Prepare = Callable[[Image, Features], Any]
OWN_MATCHERS = {*KINDS["matching"].values(), FunctionMatcher}
ImageInput = str | Path | ArrayLike | Image
"""A file, an array of levels (H, W), (H, W, 3) or (H, W, 4), a Pillow image, or an :class:`Image`."""
LENS_PAIRS, FEW_LENS_PAIRS = (
    60,
    6,
)  # pairs of images whose seeds are matched to find the lens, and a first few
MASK_REACH = 4.0  # half width, in pixels of its scale, of the window that determines the position of a corner


def match_images(config: PipelineConfig, images: tuple[Image, Image], seed: int) -> TwoView:
    """Match two images; if they do not match, again with seeds of simulated oblique views."""
    views = [config.matching.prepare(image, detect_features(config, image)) for image in images]
    masks = images[0].mask, images[1].mask
    pair = match_views(config, views[0], views[1], (0, 1), seed, masks)
    if pair.accepted or not oblique_pairs(config):
        return pair
    features = [view.features for view in views]
    views = [prepare_oblique(config, *given) for given in zip(images, features, strict=True)]
    again = match_views(config, views[0], views[1], (0, 1), seed, masks)
    return again if again.accepted else pair


def detect_features(config: PipelineConfig, image: Image) -> Features:
    """Detect the features of an image; those with a masked pixel within ``MASK_REACH`` are dropped."""
    found, clear = config.features.detect(image), _distance_to_mask(image)
    corners: Features = _unmasked(found, clear)
    return corners if found.seeds is None else replace(corners, seeds=_unmasked(found.seeds, clear))


def oblique_pairs(config: PipelineConfig) -> int:
    """Number of pairs of an image that are matched again with seeds of simulated oblique views."""
    wanted: int = getattr(config.matching, "oblique_pairs", 0)
    return wanted if getattr(config.features, "oblique_tilts", ()) else 0


def prepare_oblique(config: PipelineConfig, image: Image, features: Features) -> Any:
    """Prepare an image for matching with seeds of simulated oblique views."""
    found: Seeds = config.features.oblique_seeds(image)  # type: ignore[attr-defined]
    seeds = _unmasked(found, _distance_to_mask(image))
    return config.matching.prepare(image, replace(features, oblique=seeds))


def _distance_to_mask(image: Image) -> Any:
    """Distance (H, W) px of each pixel to the nearest masked one; None without a mask."""
    if image.mask is None or image.mask.all():
        return None
    return scipy.ndimage.distance_transform_cdt(image.mask, "chessboard")


def _unmasked(found: Any, clear: Any) -> Any:
    if clear is None:
        return found
    return select_found(found, values_at(clear, found.xy) > MASK_REACH * found.scale)


def values_at(pixels: Any, xy: Any) -> Any:
    """Values (N,) of an array (H, W) at the nearest pixels."""
    x, y = (np.clip(np.rint(xy[:, k]).astype(np.int64), 0, pixels.shape[1 - k] - 1) for k in (0, 1))
    return pixels[y, x]


def match_views(
    config: PipelineConfig, view1: Any, view2: Any, pair: tuple[int, int], seed: int,
    masks: tuple[B8 | None, B8 | None] = (None, None),
) -> TwoView:  # fmt: skip
    """Match two prepared views, estimate F and verify it; a pair without F is rejected with a reason."""
    rng = stream(seed, "matches", *pair)
    try:
        estimate = config.epipolar.estimate
        matches = config.matching.match(view1, view2, pair=pair, estimate_fundamental=estimate, rng=rng)
        if type(config.matching) not in OWN_MATCHERS:
            matches = matches_of(config.matching, matches, pair, (view1, view2))
    except StageFailure as failure:
        return _rejected_pair(pair, 0, str(failure))
    for mask, side in zip(masks, ("xy1", "xy2"), strict=True):
        if mask is not None:
            matches = select_found(matches, values_at(mask, getattr(matches, side)))
    return verify_matches(config, matches, rng)


def verify_matches(config: PipelineConfig, matches: Matches, rng: np.random.Generator) -> TwoView:
    """Estimate F of matches and verify them; a pair without F is rejected with a reason."""
    try:
        fit = config.epipolar.estimate(matches.xy1, matches.xy2, rng)
        return config.verification.verify(matches, fit, rng)
    except StageFailure as failure:
        return _rejected_pair((matches.i, matches.j), len(matches.xy1), str(failure))


def _rejected_pair(pair: tuple[int, int], candidates: int, reason: str) -> TwoView:
    index, xy, nan = np.zeros(0, dtype=np.int64), np.zeros((0, 2)), float("nan")
    F, affine = np.zeros((3, 3)), np.zeros((0, 2, 2))
    return TwoView(*pair, F, nan, index, index, xy, xy, affine, candidates, nan, False, reason)


class FromImages:
    """The front end that computes everything from the images.

    ``pairs`` replaces the method of the settings.
    """

    divides = True

    def __init__(self, pairs: PairsOfAdded | None = None) -> None:
        self.pairs = pairs

    def detect(self, job: Job) -> Sequence[Features]:
        """Detect the features of all images."""
        run, images, variant = job.run, job.images, job.run.variant_key("features")
        digests = enumerate(image.digest for image in job.inputs.decoded)
        keys = {f"{i:05d}": run.key("features", variant, digest) for i, digest in digests}

        frames = [None] * len(images) if job.prior.lens is None else list(lens.frames_of(job).values())
        if job.prior.lens is not None:
            keys = {item: run.key("features", key, job.prior.lens[int(item)]) for item, key in keys.items()}

        def batches(missing: Sequence[int]) -> Iterator[Batch]:
            return (([i], (job.config, images[i], frames[i])) for i in missing)

        return report_features(job, run.map_cached("features", keys, _detect, batches))

    def prepare(self, job: Job, features: Sequence[Features]) -> Any:
        """The views prepared by the matching method, which tracks are aligned with too."""
        views = dict(enumerate(zip(job.images, features, strict=True)))
        return PreparedViews(
            job.config.matching.prepare, views, None if job.prior.lens is None else lens.frames_of(job)
        )

    def select(self, job: Job, features: Sequence[Features]) -> PairChoice:
        """Select the pairs of images to match."""
        run, names = job.run, job.names
        more = [] if self.pairs is None else [self.pairs.before, self.pairs.count, code_digest(self.pairs)]
        key = run.key("pairs", run.variant_key("pairs"), names, run.logs["features"].keys, run.seed, *more)
        run.progress("pairs", 0, 1)
        select, rng = (self.pairs or job.config.pairs).select, stream(run.seed, "pairs")
        compute = partial(select, names, features, map_all=run.workers.map_all, rng=rng)
        choice: PairChoice = run.cached("pairs", "choice", key, compute)
        report_choice(job, choice)
        run.progress("pairs", 1, 1)
        return choice

    def lens(self, job: Job) -> F64 | None:
        """The lens that seeds of pairs show."""
        run, matching = job.run, job.config.matching
        if not isinstance(matching, SeedsAndGrowth) or len(job.images) < MIN_GROUP:
            return None
        # Of images that are added to a run, those of the run were asked before.
        n, prior = len(job.images) if self.pairs is None else self.pairs.count, job.prior
        digests = [image.digest for image in job.inputs.decoded[:n]]
        variants = [run.variant_key(stage) for stage in ("features", "matching")]
        variants.append([code_digest(estimate_division, seed_matches)])
        key = run.key("pairs", "lens", digests, variants, prior.shared[:n, 5], prior.std[:n, 5], run.seed)
        found = run.stored("pairs", "lens", key) or {"lens": self._lens(job, matching)}
        lens: F64 | None = run.cached("pairs", "lens", key, lambda: found)["lens"]
        if lens is None or len(lens) == len(job.images):
            return lens
        peers = [np.flatnonzero(prior.shared[:n, 5] == number) for number in prior.shared[n:, 5]]
        return np.vstack([lens, *(lens[own[0]] if len(own) else np.zeros(lens.shape[1]) for own in peers)])

    def _lens(self, job: Job, matching: SeedsAndGrowth) -> F64 | None:
        features = self.detect(job)
        if any(found.seeds is None for found in features):
            return None
        n, rng = len(features), stream(job.run.seed, "lens")
        first = rng.permutation(n - 1)
        others = np.sort(rng.integers(0, n, (LENS_PAIRS // 2, 2)), axis=1)

        def seeds(pairs: I64, most: int | None) -> list[Matches]:
            found = list[Matches]()
            for i, j in pairs.tolist():
                sets = seed_matches(features[i], features[j], (i, j), ratio=matching.ratio)
                found.append(max((matches for matches, _ in islice(sets, most)), key=lambda m: len(m.xy1)))
            return found

        # Half of the pairs are neighbours by name, which overlap in a sequence; few of them show most lenses.
        near = np.column_stack([first, first + 1])[: LENS_PAIRS // 2]
        # The first set of seeds is upright.
        if lens.bends_little(job, seeds(near[:FEW_LENS_PAIRS], 1)):
            return None
        some = np.unique(np.concatenate([near, others[others[:, 0] < others[:, 1]]]), axis=0)
        return lens.lens_of_matches(job, seeds(some, None))

    def match(self, job: Job, views: Sequence[Any], choice: PairChoice | None) -> Sequence[TwoView]:
        """Match the pairs and estimate their epipolar geometry; weak ones again with oblique views."""
        assert isinstance(views, PreparedViews)
        assert choice is not None
        pairs = [(int(i), int(j)) for i, j in choice.pairs]
        found, kinds = _matched_in_turn(job, views, pairs)
        again = pairs_to_connect(views.features, found, oblique_pairs(job.config))
        oblique = views.prepared_by(partial(prepare_oblique, job.config))
        while again:
            now, again = again[:OBLIQUE_PAIRS], again[OBLIQUE_PAIRS:]
            second = _matched(job, oblique, [pairs[n] for n in now], "-oblique")
            for n, pair in zip(now, second, strict=True):
                if pair.accepted:
                    found[n], kinds[n] = pair, "-oblique"
            if not any(pair.accepted for pair in second):
                break
        final = reject_repeated_structure(found, len(job.images))
        rejected = {n: pair.reason for n, pair in enumerate(final) if pair is not found[n]}
        return report_matches(job, final, kinds, rejected)

    def track(
        self, job: Job, views: Sequence[Any], pairs: Sequence[TwoView], among: Sequence[int] | None = None
    ) -> Tracks:
        """Build tracks from the accepted pairs."""
        run, accepted = job.run, [(pair.i, pair.j) for pair in pairs if pair.accepted]
        key = run.key("tracks", run.variant_key("tracks"), run.logs["matches"].keys, accepted, run.seed)
        rng = stream(run.seed, "tracks")
        compute = partial(build_tracks, job, views, pairs, rng)
        return report_tracks(run, run.cached("tracks", "tracks", key, compute))


def build_tracks(job: Job, views: Any, pairs: Sequence[TwoView], rng: np.random.Generator) -> Tracks:
    """Tracks of the accepted pairs, in pixels of the images."""
    frames = views.frames if isinstance(views, PreparedViews) else None
    if frames is not None:
        pairs = [lens.pair_in_frames(pair, frames[pair.i], frames[pair.j]) for pair in pairs]
    found: Tracks = job.config.tracks.build(views, pairs, map_all=job.run.workers.map_all, rng=rng)
    if frames is None:
        return found
    xy = found.xy.copy()
    for view, frame in frames.items():
        here = found.view_index == view
        xy[here] = frame.bent(xy[here])
    return replace(found, xy=xy)


class FromRun:
    """The front end of some images of another run, from which it takes features and pairs."""

    divides = False

    def __init__(
        self, whole: Job, views: Sequence[int], features: Sequence[Features], pairs: Sequence[TwoView],
        tracks: Tracks | None = None,
    ) -> None:  # fmt: skip
        self.whole, self.views, self.features, self.pairs = whole, views, features, pairs
        self.tracks = tracks

    def detect(self, job: Job) -> Sequence[Features]:
        """The features of the images."""
        keys = list(self.whole.run.logs["features"].keys.values())
        found = [
            job.run.cached("features", f"{k:05d}", keys[i], partial(self.features.__getitem__, i))
            for k, i in enumerate(self.views)
        ]
        return report_features(job, found)

    def prepare(self, job: Job, features: Sequence[Features]) -> Any:
        """The views as the other run takes them."""
        return self.whole.front.prepare(job, features)

    def select(self, job: Job, features: Sequence[Features]) -> None:
        """No choice: the pairs are those of the other run."""

    def lens(self, job: Job) -> F64 | None:
        """The lens of the other run."""
        return None if self.whole.prior.lens is None else self.whole.prior.lens[list(self.views)]

    def match(self, job: Job, views: Sequence[Any], choice: PairChoice | None) -> Sequence[TwoView]:
        """The pairs within the images."""
        run, number = job.run, {view: k for k, view in enumerate(self.views)}
        keys, found = list(self.whole.run.logs["matches"].keys.values()), list[TwoView]()
        for key, pair in zip(keys, self.pairs, strict=False):
            if {pair.i, pair.j} <= number.keys():
                pair = replace(pair, i=number[pair.i], j=number[pair.j])
                # The final matches and the decision about a pair depend on all images, not only on its two.
                content = [pair.index1, pair.index2, pair.xy1, pair.xy2, pair.affine]
                key = run.key("matches", key, pair.i, pair.j, content, pair.accepted, pair.reason)
                item = _item(pair.i, pair.j, "")
                found.append(run.cached("matches", item, key, partial(replace, pair)))
        return report_matches(job, found)

    def track(
        self, job: Job, views: Sequence[Any], pairs: Sequence[TwoView], among: Sequence[int] | None = None
    ) -> Tracks:
        """The tracks of the other run's model, if it leaves these images over, or those it gives them."""
        if self.tracks is None or not np.isin(self.views, self.tracks.view_index).all():
            return self.whole.front.track(job, views, pairs, self.views)
        return report_given(job.run, tracks_of_part(self.tracks, np.array(self.views)), pairs)


class PreparedViews(Sequence[Any]):
    """Views prepared for matching on demand, in a least-recently-used cache that is never pickled."""

    def __init__(
        self, prepare: Prepare, given: Mapping[int, tuple[Image, Features]],
        frames: Mapping[str, lens.StraightFrame] | None = None,
    ) -> None:  # fmt: skip
        self._prepare, self._given, self._frames = prepare, dict(given), frames
        # The cache may hold the same views of several methods.
        self._method = object()
        self._made: RecentlyUsed[tuple[object, int], Any] = RecentlyUsed(CACHE_BYTES)

    def __reduce__(self) -> tuple[type[PreparedViews], tuple[Any, ...]]:
        return PreparedViews, (self._prepare, self._given, self._frames)

    def __len__(self) -> int:
        return len(self._given)

    def __getitem__(self, view: int) -> Any:  # type: ignore[override]
        if view not in self._given:
            raise IndexError(f"view {view} is not among those given")
        prepare = self._prepare if self._frames is None else lens.Straightened(self._prepare, self._frames)
        return self._made.get((self._method, view), lambda: prepare(*self._given[view]))

    def prepared_by(self, prepare: Prepare) -> PreparedViews:
        """The same views by another method, in the same cache."""
        other = PreparedViews(prepare, self._given, self._frames)
        other._made = self._made
        return other

    @property
    def features(self) -> list[Features]:
        """Features of the views."""
        return [features for _, features in self._given.values()]

    def masks(self, i: int, j: int) -> tuple[B8 | None, B8 | None]:
        """Masks of two views, None: all pixels; straight images have no corners near masked pixels."""
        return (None, None) if self._frames else (self._given[i][0].mask, self._given[j][0].mask)

    @property
    def frames(self) -> Mapping[int, lens.StraightFrame] | None:
        """The straight frames of all views by number, if their images are straightened."""
        if self._frames is None:
            return None
        return {view: self._frames[image.name] for view, (image, _) in self._given.items()}

    def subset(self, views: Iterable[int]) -> PreparedViews:
        """The same for some views, with an empty cache."""
        return PreparedViews(self._prepare, {view: self._given[view] for view in views}, self._frames)


def batch_pairs(
    pairs: Sequence[tuple[int, int]], numbers: Sequence[int], workers: int | None, corners: Sequence[int]
) -> list[list[int]]:
    """Divide the ``numbers`` of pairs (i < j) into batches of few different views.

    The ``corners`` of each view bound the bytes of a result. ``workers`` None: batches of one pair.
    """
    first, second = ([pairs[n][side] for n in numbers] for side in (0, 1))
    left = {pairs[numbers[k]]: numbers[k] for k in cached_pair_order(first, second)}
    if workers is None:
        return [[n] for n in left.values()]
    size = min(max(len(numbers) // (BATCHES_PER_WORKER * workers), 1), MAX_BATCH)
    batches, room = list[list[int]](), 0
    for (i, j), n in left.items():
        needed = PAIR_BYTES + MATCH_BYTES * min(corners[i], corners[j])
        if not batches or len(batches[-1]) == size or needed > room:
            batches.append([])
            room = MAX_RESULT_BYTES
        batches[-1].append(n)
        room -= needed
    return batches


def _detect(config: PipelineConfig, image: Image, frame: lens.StraightFrame | None) -> list[Features]:
    if frame is None:
        return [detect_features(config, image)]
    return [frame.features(detect_features(config, frame.image(image)), straight=False)]


def _matched_in_turn(
    job: Job, views: PreparedViews, pairs: Sequence[tuple[int, int]]
) -> tuple[list[TwoView], list[str]]:
    """Match pairs, and return the kind of record of each too; in large sets first with part of the corners.

    That is not enough for weak pairs, and for all pairs of a long sequence, where errors accumulate.
    """
    features, matching = views.features, job.config.matching
    if not isinstance(matching, SeedsAndGrowth) or len(features) <= matching.many_images:
        return _matched(job, views, pairs, ""), [""] * len(pairs)
    found = _matched(job, views.prepared_by(partial(_prepare_share, matching)), pairs, FEWER)
    found, kinds = _of_all_corners(found, features, matching.many_share), [FEWER] * len(pairs)
    kept = reject_repeated_structure(found, len(features))
    long = has_narrow_cut(tracks_of_corners([found.xy for found in features], kept))
    again = [n for n, pair in enumerate(found) if long or not pair.accepted or pair.inliers < MIN_VERIFIED]
    second = _matched(job, views, [pairs[n] for n in again], "")
    for n, pair in zip(again, second, strict=True):
        if pair.accepted or not found[n].accepted:
            found[n], kinds[n] = pair, ""
    return found, kinds


def _of_all_corners(pairs: Sequence[TwoView], features: Sequence[Features], share: float) -> list[TwoView]:
    """Pairs matched with part of the corners, with indices into all corners."""
    rows = [strongest_corners(f, share) for f in features]
    return [replace(p, index1=rows[p.i][p.index1], index2=rows[p.j][p.index2]) for p in pairs]


def _prepare_share(matching: SeedsAndGrowth, image: Image, features: Features) -> Any:
    return matching.prepare(image, strongest_share(features, matching.many_share))


def _matched(job: Job, views: PreparedViews, pairs: Sequence[tuple[int, int]], kind: str) -> list[TwoView]:
    """Match pairs of prepared views; ``kind`` names another way of preparation."""
    run, shared = job.run, job.run.workers.in_process
    variants = [run.variant_key(stage) for stage in ("matching", "epipolar", "verification")]
    features = list(run.logs["features"].keys.values())
    inputs = {(i, j): (features[i], features[j], run.seed, i, j, *([kind] if kind else [])) for i, j in pairs}
    keys = {_item(i, j, kind): run.key("matches", variants, *inputs[i, j]) for i, j in pairs}

    def batches(missing: Sequence[int]) -> Iterator[Batch]:
        corners = [len(f.xy) for f in views.features]
        for numbers in batch_pairs(pairs, missing, None if shared else run.workers.parallel(), corners):
            some = [pairs[n] for n in numbers]
            given = views if shared else views.subset({view for pair in some for view in pair})
            yield numbers, (job.config, given, some, run.seed)

    return list(run.map_cached("matches", keys, _match_all, batches))


def _match_all(
    config: PipelineConfig, views: PreparedViews, pairs: Sequence[tuple[int, int]], seed: int
) -> list[TwoView]:
    frames = views.frames
    found = [match_views(config, views[i], views[j], (i, j), seed, views.masks(i, j)) for i, j in pairs]
    return found if frames is None else [lens.pair_from_frames(p, frames[p.i], frames[p.j]) for p in found]


def _item(i: int, j: int, kind: str) -> str:
    return f"{i:05d}-{j:05d}{kind}"


def report_features(job: Job, features: Sequence[Features]) -> Sequence[Features]:
    """Report the features of all images; return them."""
    min_corners, found = 16, [len(f.xy) for f in features]
    few = [(image, n) for image, n in zip(job.images, found, strict=True) if n < min_corners]
    poor = [Notice("few-corners", image.name, counted(n, "corner")) for image, n in few]
    counts = {"images": len(found), "corners": sum(found), "fewest_in_one_image": min(found)}
    job.run.finish("features", counts=counts, warnings=poor)
    return features


def report_choice(job: Job, choice: PairChoice) -> None:
    """Report the pairs that are to be matched."""
    possible = len(job.images) * (len(job.images) - 1) // 2
    counts = {"possible": possible, "compared": choice.compared, "chosen": len(choice.pairs)}
    job.run.finish("pairs", counts=counts)


def report_matches(
    job: Job, pairs: Sequence[TwoView], kinds: Sequence[str] | None = None,
    rejected: Mapping[int, str] | None = None,
) -> Sequence[TwoView]:  # fmt: skip
    """Report the matched pairs; return them.

    Unless they are the stored records, another record lists their ``kinds``, and the reasons of those that
    are ``rejected`` (by number) because of other pairs.
    """
    run, rejected, kinds = job.run, rejected or {}, kinds or [""] * len(pairs)
    items = [_item(pair.i, pair.j, kind) for pair, kind in zip(pairs, kinds, strict=True)]
    if rejected or any(kinds) or items != sorted(run.logs["matches"].keys):
        final = {"items": items, "rejected": {items[n]: reason for n, reason in rejected.items()}}
        run.cached("matches", FINAL, run.key("matches", FINAL, final), lambda: final)
    accepted = [pair for pair in pairs if pair.accepted]
    undetermined = [pair for pair in accepted if pair.undetermined]
    counts = {"pairs": len(pairs), "accepted": len(accepted)}
    counts |= {"verified": sum(p.inliers for p in accepted), "undetermined": len(undetermined)}
    metrics = {"median_sigma_px": float(np.median([p.sigma_px for p in accepted]))} if accepted else {}
    warnings = list[str]()
    if 2 * len(undetermined) > len(accepted):
        found = Counter(pair.configuration for pair in undetermined)
        listed = ", ".join(f"{count} {kind}" for kind, count in sorted(found.items()))
        of_all = f"{len(undetermined)} of {len(accepted)} accepted pairs"
        warnings.append(Notice("degenerate-pairs", of_all, listed))
    run.finish("matches", counts=counts, metrics=metrics, warnings=warnings)
    return pairs


def final_pairs(records: Mapping[str, Any], features: Sequence[Features]) -> tuple[TwoView, ...]:
    """The pairs that :func:`report_matches` reported, from the records of the stage."""
    if FINAL not in records:
        return tuple(records.values())
    final = records[FINAL]
    fewer = [item for item in final["items"] if item.endswith(FEWER)]
    whole = _of_all_corners([records[item] for item in fewer], features, SeedsAndGrowth.many_share)
    pairs = {item: records[item] for item in final["items"]} | dict(zip(fewer, whole, strict=True))
    for item, reason in final["rejected"].items():
        pairs[item] = replace(pairs[item], accepted=False, reason=reason)
    return tuple(pairs.values())


def require_accepted_pair(pairs: Sequence[TwoView]) -> None:
    """Raise ``StageFailure`` if no pair is accepted."""
    if not any(pair.accepted for pair in pairs):
        best = max(pairs, key=lambda pair: pair.inliers)
        tried, verified = counted(len(pairs), "pair"), counted(best.inliers, "verified match")
        raise StageFailure.of("no-match", tried, verified, best.reason)


def report_given(run: Run, tracks: Tracks, pairs: Sequence[TwoView]) -> Tracks:
    """Store and report tracks that need not be built, and the pairs they come with; return them."""
    geometry = [[pair.i, pair.j, pair.F] for pair in pairs if pair.accepted]
    key = run.key("tracks", "given", tracks.view_index, tracks.point_index, tracks.xy, geometry)
    return report_tracks(run, run.cached("tracks", "tracks", key, lambda: tracks))


def report_tracks(run: Run, tracks: Tracks) -> Tracks:
    """Report the tracks; return them."""
    seen = np.bincount(tracks.point_index, minlength=tracks.n_points)
    counts = {"points": tracks.n_points, "observations": len(tracks.xy)}
    run.finish("tracks", counts=counts | {"seen_3_times": int((seen >= 3).sum())})
    return tracks


def image_groups(n_views: int, pairs: Sequence[TwoView], among: B8 | None = None) -> list[list[int]]:
    """Groups of ``MIN_GROUP`` images or more (``among``) that accepted pairs connect, largest first."""
    inside = np.ones(n_views, dtype=bool) if among is None else among
    links = [(p.i, p.j) for p in pairs if p.accepted and inside[p.i] and inside[p.j]]
    label = connected_groups(n_views, links)
    groups = [group.tolist() for group in rows_of_views(label, label.max() + 1)]
    return sorted((group for group in groups if len(group) >= MIN_GROUP), key=len, reverse=True)
