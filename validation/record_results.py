"""Record every number of some runs, and compare two records: ``python -m validation.record_results``.

A refactoring must not change what the program computes. ``write`` reconstructs the recorded sets and stores the
numbers of ``summary.json`` and SHA-256 digests of every array of every stage, of ``sparse/0`` and of the model.
``compare`` reads two such records. Where the bytes of intrinsics differ, it reports the difference in standard
deviations. Digests are compared without the names of fields and files, so that these may be renamed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import sys
import tempfile
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
PHOTOGRAPHS = {
    "courtyard": (ROOT / "fixtures" / "courtyard" / "images", "model"),
    "fountain-P11": (DATA / "strecha" / "fountain-P11", "metric"),
    "Herz-Jesus-P8": (DATA / "strecha" / "Herz-Jesus-P8", "metric"),
    "kermit": (DATA / "kermit", "metric"),
}
TRACKS = ("cube", "dinosaur")
PRESETS = ("default", "thesis")
VOLATILE = ("seconds", "memory", "version", "out", "path", "time", "threads")


def digest(array: Any) -> str:
    """Digest of the dtype, shape and bytes of an array."""
    values = np.ascontiguousarray(array)
    head = f"{values.dtype.str} {values.shape} ".encode()
    return hashlib.sha256(head + values.tobytes()).hexdigest()[:16]


def numbers_of(value: Any, place: str = "") -> dict[str, float]:
    """Every number of a JSON value by its path, without times and memory."""
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


def arrays_of(record: Any) -> list[str]:
    """Digests of all arrays in nested records."""
    if isinstance(record, np.ndarray):
        return [digest(record)]
    if is_dataclass(record) and not isinstance(record, type):
        return [d for f in fields(record) for d in arrays_of(getattr(record, f.name))]
    if isinstance(record, dict):
        return [d for item in record.values() for d in arrays_of(item)]
    if isinstance(record, list | tuple):
        return [d for item in record for d in arrays_of(item)]
    return []


def stage_digests(out: Path) -> dict[str, list[str]]:
    """Sorted digests of the arrays of every stage folder, by the number that the folder begins with."""
    found: dict[str, list[str]] = {}
    for folder in sorted(p for p in out.iterdir() if p.is_dir() and p.name[:2].isdigit()):
        every = []
        for path in sorted(folder.glob("*.npz")):
            with np.load(path) as file:
                every += [digest(file[name]) for name in file.files if name != "description"]
        found[folder.name[:2]] = sorted(every)
    return found


def file_digests(out: Path) -> dict[str, str]:
    """Digests of the files that a run leaves for its user."""
    names = ["points.ply", "model.glb", "affine.ply", *(f"sparse/0/{p.name}" for p in out.glob("sparse/0/*"))]
    return {n: hashlib.sha256((out / n).read_bytes()).hexdigest()[:16] for n in names if (out / n).exists()}


def record_photographs(name: str, preset: str, folder: Path) -> dict[str, Any]:
    """Run the command on one set of images and digest what it leaves."""
    from thesisrecon.cli.main import run_command

    images, until = PHOTOGRAPHS[name]
    if (images / "images").is_dir():
        images = images / "images"
    out = folder / f"{name}-{preset}"
    code = run_command(
        ["reconstruct", str(images), "-o", str(out), "--preset", preset, "--until", until, "--threads", "2"]
    )
    summary = json.loads((out / "summary.json").read_text()) if (out / "summary.json").exists() else {}
    return {
        "code": code,
        "summary": numbers_of(summary),
        "files": file_digests(out),
        "stages": stage_digests(out),
    }


def record_tracks(name: str, preset_name: str) -> dict[str, Any]:
    """Projective reconstruction, self-calibration and metric refinement of given tracks."""
    from thesisrecon import self_calibrate
    from thesisrecon.config import preset
    from thesisrecon.errors import StageFailure
    from thesisrecon.intrinsics import prior_for
    from thesisrecon.records import Tracks
    from thesisrecon.runtime.run import stream
    from validation.scenes.dinosaur import load_dinosaur, pairs_from_tracks

    if name == "cube":
        cube = np.load(ROOT / "fixtures" / "cube" / "cube.npz")
        xy = cube["xy"] + np.random.default_rng(7).normal(scale=0.3, size=cube["xy"].shape)
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
            projective, calibration, prior=prior_for(projective, config.intrinsics), rng=stream(0, "metric", 0)
        )
        r = metric.reconstruction
        digests["metric"] = arrays_of([r.P, r.X, r.K, r.inlier, r.registered])
        for view, intervals in enumerate(metric.intrinsics):
            for key, interval in intervals.items():
                summary[f"/cameras/{view}/{key}/value"] = interval.value
                summary[f"/cameras/{view}/{key}/std"] = interval.std
        summary["/points"] = float(r.valid.sum())
    except StageFailure as failure:
        summary["/failed"] = 1.0
        print(f"{name} {preset_name}: {failure}")
    return {"code": 0, "summary": summary, "files": {}, "stages": digests}


def write(target: Path, folder: Path | None, sets: list[str], presets: list[str]) -> None:
    """Record the sets one by one; the file is written again after each."""
    record: dict[str, Any] = json.loads(target.read_text()) if target.exists() else {}
    work = folder or Path(tempfile.mkdtemp())
    for name in sets:
        for preset in presets:
            if name in TRACKS:
                record[f"{name} {preset}"] = record_tracks(name, preset)
            elif PHOTOGRAPHS[name][0].is_dir():
                record[f"{name} {preset}"] = record_photographs(name, preset, work)
            target.write_text(json.dumps(record, indent=1, sort_keys=True) + "\n")
            print(f"{name} {preset}: recorded", flush=True)
    if folder is None:
        shutil.rmtree(work)


def compare(before: Path, after: Path) -> int:
    """Print what differs; 1 where anything does."""
    old, new = json.loads(before.read_text()), json.loads(after.read_text())
    differs = 0
    for run in sorted(set(old) & set(new)):
        a, b = old[run], new[run]
        lines = [] if a.get("code") == b.get("code") else [f"exit code {a.get('code')} -> {b.get('code')}"]
        for kind in ("files", "stages"):
            for name in sorted(set(a.get(kind, {})) | set(b.get(kind, {}))):
                if a[kind].get(name) != b[kind].get(name):
                    lines.append(f"{kind}: {name} differs")
        lines += summary_differences(a.get("summary", {}), b.get("summary", {}))
        print(f"{run}: {'same bytes' if not lines else ''}")
        for line in lines:
            print(f"    {line}")
        differs |= bool(lines)
    for run in sorted(set(old) ^ set(new)):
        print(f"{run}: only in one record")
    return int(differs)


def summary_differences(a: dict[str, float], b: dict[str, float]) -> list[str]:
    """Numbers that differ, those with a standard deviation in units of it."""
    lines = []
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
    only = [k for k in sorted(set(a) ^ set(b))]
    if only:
        values = sorted(a[k] for k in only if k in a) == sorted(b[k] for k in only if k in b)
        if not values:
            lines.append(f"{len(only)} numbers stand in one record only, as {only[:3]}")
    return lines


def main(arguments: list[str] | None = None) -> int:
    """``write FILE`` or ``compare BEFORE AFTER``."""
    parser = argparse.ArgumentParser(prog="python -m validation.record_results", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    writing = commands.add_parser("write")
    writing.add_argument("file", type=Path)
    writing.add_argument("--folder", type=Path, help="keep the output folders here")
    writing.add_argument("--sets", nargs="+", default=[*TRACKS, *PHOTOGRAPHS])
    writing.add_argument("--presets", nargs="+", default=list(PRESETS))
    comparing = commands.add_parser("compare")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    options = parser.parse_args(arguments)
    if options.command == "compare":
        return compare(options.before, options.after)
    write(options.file, options.folder, options.sets, options.presets)
    return 0


if __name__ == "__main__":
    sys.exit(main())
