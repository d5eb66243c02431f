"""A record of every number of some runs, and the comparison of two records.

A refactoring must not change the results. ``--write-to`` reconstructs the recorded sets and stores the
numbers of ``summary.json`` and SHA-256 digests of every array of every stage, of ``sparse/0`` and of the
model. ``--compare-with`` reads two such records. If the bytes of intrinsics differ, it reports the difference
in standard deviations. Digests ignore the names of fields and files, so that these may be renamed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.errors import UsageError
from validation.runs.study import Part, pick
from validation.runs.tables import Rows
from validation.scenes.real import FOLDERS, REAL_SCENES, Scene, load_scene

LAST_STAGE = {"courtyard": "model", **dict.fromkeys(FOLDERS, "metric")}
"""Image sets and the last stage of their runs."""
TRACKS = ("cube", "dinosaur")
PRESETS = ("default", "thesis")
VOLATILE = ("seconds", "memory", "version", "out", "path", "time", "threads")


def digest(array: Any) -> str:
    values = np.ascontiguousarray(array)
    head = f"{values.dtype.str} {values.shape} ".encode()
    return hashlib.sha256(head + values.tobytes()).hexdigest()[:16]


def numbers_of(value: Any, place: str = "") -> dict[str, float]:
    """Return every number of a JSON value by its path, without times and memory."""
    if isinstance(value, bool):
        return {place: float(value)}
    if isinstance(value, int | float):
        return {place: float(value)}
    items: Any = ()
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, list | tuple):
        items = enumerate(value)
    found: dict[str, float] = {}
    for key, item in items:
        if not any(word in str(key) for word in VOLATILE):
            found.update(numbers_of(item, f"{place}/{key}"))
    return found


def combined(digests: list[str] | str) -> str:
    if isinstance(digests, str):
        return digests
    return f"{len(digests)}:{hashlib.sha256(' '.join(digests).encode()).hexdigest()[:16]}"


def arrays_of(record: Any) -> list[str]:
    if isinstance(record, np.ndarray):
        return [digest(record)]
    if is_dataclass(record) and not isinstance(record, type):
        return [d for f in fields(record) for d in arrays_of(getattr(record, f.name))]
    if isinstance(record, dict):
        return [d for item in record.values() for d in arrays_of(item)]
    if isinstance(record, list | tuple):
        return [d for item in record for d in arrays_of(item)]
    return []


def stage_digests(out: Path) -> dict[str, str]:
    """Return sorted digests of the arrays of every stage folder, by the number of the folder."""
    found: dict[str, str] = {}
    for folder in sorted(p for p in out.iterdir() if p.is_dir() and p.name[:2].isdigit()):
        every = []
        for path in sorted(folder.glob("*.npz")):
            with np.load(path) as file:
                every += [digest(file[name]) for name in file.files if name != "description"]
        found[folder.name[:2]] = combined(sorted(every))
    return found


def file_digests(out: Path) -> dict[str, str]:
    names = ["points.ply", "model.glb", "affine.ply", *(f"sparse/0/{p.name}" for p in out.glob("sparse/0/*"))]
    return {n: hashlib.sha256((out / n).read_bytes()).hexdigest()[:16] for n in names if (out / n).exists()}


def record_images(scene: Scene, preset: str, folder: Path) -> dict[str, Any]:
    from thesisrecon.cli.main import run_command

    images, out = scene.image_paths[0].parent, folder / f"{scene.name}-{preset}"
    command = ["reconstruct", str(images), "-o", str(out), "--preset", preset]
    code = run_command([*command, "--until", LAST_STAGE[scene.name], "--threads", "2"])
    summary = json.loads((out / "summary.json").read_text()) if (out / "summary.json").exists() else {}
    return {
        "code": code,
        "summary": numbers_of(summary),
        "files": file_digests(out),
        "stages": stage_digests(out),
    }


def record_tracks(name: str, preset_name: str) -> dict[str, Any]:
    """Digest projective reconstruction, self-calibration and metric refinement of given tracks."""
    from thesisrecon import self_calibrate
    from thesisrecon.config import preset
    from thesisrecon.config.intrinsics import prior_for
    from thesisrecon.errors import StageFailure
    from thesisrecon.records import Tracks
    from thesisrecon.runtime._run import stream
    from validation.scenes.cube import make_cube
    from validation.scenes.dinosaur import load_dinosaur, pairs_from_tracks

    if name == "cube":
        exact = make_cube().xy
        xy = exact + np.random.default_rng(7).normal(scale=0.3, size=exact.shape)
        point, view = np.nonzero(np.isfinite(xy).all(axis=2).T)
        tracks = Tracks(view.astype(np.int64), point.astype(np.int64), xy[view, point], len(xy), xy.shape[1])
        sizes = np.tile(np.array([800, 600], dtype=np.int64), (len(xy), 1))
    else:
        dinosaur = load_dinosaur()
        if dinosaur is None:
            return {}
        tracks, sizes = dinosaur.tracks, dinosaur.sizes
    config = preset(preset_name)
    pairs = pairs_from_tracks(tracks)
    digests: dict[str, Any] = {"pairs": arrays_of(pairs)}
    summary: dict[str, float] = {}
    try:
        projective = config.projective.reconstruct(tracks, pairs, sizes, rng=stream(0, "projective", 0))
        digests["projective"] = arrays_of(
            [projective.P, projective.X, projective.inlier, projective.registered]
        )
        calibration = self_calibrate(projective, config=config)
        digests["calibration"] = arrays_of(
            [calibration.metric_from_projective, calibration.K, calibration.K_std]
        )
        metric = config.metric.refine(
            projective,
            calibration,
            prior=prior_for(projective, config.intrinsics),
            rng=stream(0, "metric", 0),
            threads=1,
        )
        r = metric.reconstruction
        digests["metric"] = arrays_of([r.P, r.X, r.K, r.inlier, r.registered])
        for number, intervals in enumerate(metric.intrinsics):
            for key, interval in intervals.items():
                summary[f"/cameras/{number}/{key}/value"] = interval.value
                summary[f"/cameras/{number}/{key}/std"] = interval.std
        summary["/points"] = float(r.valid.sum())
    except StageFailure as failure:
        summary["/failed"] = 1.0
        print(f"{name} {preset_name}: {failure}")
    stages = {name: combined(every) for name, every in digests.items()}
    return {"code": 0, "summary": summary, "files": {}, "stages": stages}


def write(target: Path, folder: Path, sets: Sequence[str], presets: Sequence[str]) -> Iterator[str]:
    """Record the sets one by one; the file is rewritten after each."""
    record: dict[str, Any] = json.loads(target.read_text()) if target.exists() else {}
    for name in sets:
        for preset in presets:
            if name in TRACKS:
                record[f"{name} {preset}"] = record_tracks(name, preset)
            elif (scene := load_scene(name)) is not None:
                record[f"{name} {preset}"] = record_images(scene, preset, folder)
            target.write_text(json.dumps(record, indent=1, sort_keys=True) + "\n")
            yield f"{name} {preset}: recorded"


def compare(before: Path, after: Path) -> Iterator[tuple[str, bool]]:
    """Give a report of each run and whether it differs."""
    old, new = json.loads(before.read_text()), json.loads(after.read_text())
    for run in sorted(set(old) & set(new)):
        a, b = ({"files": {}, "stages": {}} | record[run] for record in (old, new))
        lines = [] if a.get("code") == b.get("code") else [f"exit code {a.get('code')} -> {b.get('code')}"]
        for kind in ("files", "stages"):
            for name in sorted(set(a[kind]) | set(b[kind])):
                if combined(a[kind].get(name, "")) != combined(b[kind].get(name, "")):
                    lines.append(f"{kind}: {name} differs")
        lines += summary_differences(a.get("summary", {}), b.get("summary", {}))
        yield "\n    ".join([f"{run}: {'' if lines else 'same bytes'}", *lines]), bool(lines)
    for run in sorted(set(old) ^ set(new)):
        yield f"{run}: only in one record", True


def summary_differences(a: dict[str, float], b: dict[str, float]) -> list[str]:
    """Return the numbers that differ; those with a standard deviation in units of it."""
    lines: list[str] = []
    worst = 0.0
    for key in sorted(set(a) & set(b)):
        if a[key] == b[key] or (np.isnan(a[key]) and np.isnan(b[key])):
            continue
        std = a.get(key.removesuffix("value") + "std", 0.0) if key.endswith("/value") else 0.0
        if std > 0.0:
            worst = max(worst, abs(a[key] - b[key]) / std)
        elif len(lines) < 12:
            lines.append(f"{key}: {a[key]!r} -> {b[key]!r}")
    if worst:
        lines.append(f"largest difference of an intrinsic: {worst:.2e} standard deviations")
    only = sorted(set(a) ^ set(b))
    if only:
        values = sorted(a[k] for k in only if k in a) == sorted(b[k] for k in only if k in b)
        if not values:
            lines.append(f"{len(only)} numbers are in one record only, such as {only[:3]}")
    return lines


def record_study(
    out: Path,
    write_to: Path | None = None,
    sets: Sequence[str] = (*TRACKS, "courtyard", *REAL_SCENES),
    presets: Sequence[str] = PRESETS,
    compare_with: Sequence[Path] = (),
) -> Iterator[Part]:
    """Record every number of some runs in a file, or compare two such files."""
    if write_to is not None:
        yield from write(write_to, out, pick(sets, (*TRACKS, *LAST_STAGE)), presets)
    elif len(compare_with) == 2:
        found = list(compare(*compare_with))
        yield from (text for text, _ in found)
        rows = Rows("records", "after")
        rows.add("runs that differ", sum(differs for _, differs in found), at_most=0.0)
        yield rows
    else:
        raise UsageError("give --write-to FILE or --compare-with BEFORE AFTER")
