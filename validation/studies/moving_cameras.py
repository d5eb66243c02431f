"""Stated focal lengths of cars that turn a corner and of hand-held videos, with known truth.

The camera is as assumed (square pixels, radial distortion, all rows at once), or slightly different. The
errors in stated standard deviations should have mean 0 and standard deviation 1 if it is as assumed, and
95 % intervals should contain the truth if it is slightly different.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from thesisrecon import RunResult, reconstruct, reconstruct_from_tracks
from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from validation.runs.study import Part
from validation.runs.tables import text_table
from validation.scenes.moving import Lens, Moving, drive, hand_held, render_drive

CASES: dict[str, tuple[Callable[[int, Lens], Moving], Lens]] = {
    "car, camera as assumed": (drive, Lens()),
    "car, k1 = 0.015": (drive, Lens(k1=0.015)),
    "car, k1 = -0.015": (drive, Lens(k1=-0.015)),
    "car, aspect ratio 1.005": (drive, Lens(aspect=1.005)),
    "car, principal point 2 % off": (drive, Lens(centre=0.02)),
    "car, p1 = 0.001, p2 = 0.0005": (drive, Lens(tangential=(0.001, 0.0005))),
    "hand-held, camera as assumed": (hand_held, Lens()),
    "hand-held, readout 5 ms": (hand_held, Lens(readout=0.05)),
    "hand-held, readout 25 ms": (hand_held, Lens(readout=0.25)),
}
"""Images of the hand-held videos are 0.1 s apart."""
RENDERED = {
    "rendered car, camera as assumed": (drive, Lens()),
    "rendered car, k1 = 0.015, aspect ratio 1.002": (drive, Lens(k1=0.015, aspect=1.002)),
}


def measure(scene: Moving) -> F64 | None:
    """Trusted (0 or 1), relative error of the focal length and its relative standard deviation."""
    return _measured(lambda: reconstruct_from_tracks(scene.xy, [scene.size] * len(scene.xy)), scene.focal)


def _measured(run: Callable[[], RunResult], truth: float) -> F64 | None:
    try:
        result = run()
    except StageFailure:
        return None
    camera = next(iter(result.cameras.values()))
    assert result.metric is not None
    assert camera.std is not None
    focal, std = camera.K[0, 0], camera.std["focal_px"]
    return np.array([result.metric.trusted, focal / truth - 1.0, std / truth])


def measure_rendered(seed: int, lens: Lens) -> F64 | None:
    """The same from images of a rendered drive."""
    with tempfile.TemporaryDirectory() as name:
        images, out = Path(name, "images"), Path(name, "out")
        focal = render_drive(images, seed, lens)
        return _measured(lambda: reconstruct(images, out, until="metric"), focal)


def moving_cameras_study(trials: int = 60, *, rendered: bool = False) -> Iterator[Part]:
    """Check focal lengths of cars that turn and of hand-held videos, with slightly wrong lenses too."""
    head = ["camera", "results", "trusted", "of these: mean z", "standard deviation of z", "within 95 %",
            "largest z", "median error, %", "median standard deviation, %"]  # fmt: skip
    rows = []
    for name, (make, lens) in (RENDERED if rendered else CASES).items():
        tried = (measure_rendered(k, lens) if rendered else measure(make(k, lens)) for k in range(trials))
        found = [r for r in tried if r is not None]
        trusted, error, std = np.array([r for r in found if r[0]]).reshape(-1, 3).T
        z = error / std
        rows.append([
            name, f"{len(found)} of {trials}", len(trusted), f"{z.mean():.2f}", f"{z.std():.2f}",
            f"{np.mean(np.abs(z) < 1.96):.0%}", f"{np.abs(z).max():.1f}",
            f"{100.0 * np.median(np.abs(error)):.2f}", f"{100.0 * np.median(std):.2f}",
        ])  # fmt: skip
    yield text_table(head, rows)
