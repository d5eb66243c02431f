"""Every method's distance from the bound and its time: ``python -m validation.studies.epipolar_methods``.

All methods see the same matches. What is told is the root of the mean (and the median) over the trials of the
squared ratio between a method's RMS distance of the exact points to its epipolar lines and the KCR bound on
it. An estimator that reaches the bound has 1; its median is then about 0.95, as seven parameters carry the
error.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.epipolar.configuration import Configuration
from thesisrecon.epipolar.precision import fundamental_bound
from thesisrecon.geometry.two_view import symmetric_residuals
from thesisrecon.io.files import write_text
from validation.studies.epipolar_catalogue import DEFAULT, GOLD, METHODS, THRESHOLD_PX, TOLD_SIGMAS, Method
from validation.references.libraries import PACKAGES, one_thread
from validation.scenes.two_views import make_two_views

SIZE = (1280.0, 960.0)
WRONG, WRONG_NOISE_PX = 0.2, 1.0
ALLOWED = 1.05


@dataclass(frozen=True)
class Setting:
    """One cell: noise (px) of each coordinate, matches, and the share of them that is wrong."""

    sigma_px: float
    n: int
    wrong: float = 0.0


@dataclass(frozen=True)
class Result:
    """A method in one cell: ratios to the bound over ``trials``, median milliseconds of processor time, and
    how many trials gave no F. ``told`` says whether the threshold was made for the noise."""

    method: str
    setting: Setting
    told: bool
    rms_ratio: float
    median_ratio: float
    time_ms: float
    failures: int
    trials: int

    @property
    def label(self) -> str:
        """The method, with the threshold where it was told the noise."""
        return f"{self.method}, {TOLD_SIGMAS:g} sigma" if self.told else self.method


@dataclass(frozen=True)
class Trial:
    """Noisy matches, the exact places of the right ones, and the bound (px) of the right ones."""

    xy1: F64
    xy2: F64
    exact1: F64
    exact2: F64
    bound_px: float

    def ratio(self, F: F64) -> float:
        """RMS distance of the exact points to the epipolar lines of F over the bound."""
        squared = float(np.mean(symmetric_residuals(F, self.exact1, self.exact2) ** 2))
        return float(np.sqrt(squared / 2.0)) / self.bound_px


def make_trial(setting: Setting, seed: int) -> Trial:
    """The trial of this seed: a new scene, new noise, and wrong matches anywhere in the second image."""
    rng = np.random.default_rng(seed)
    scene = make_two_views(Configuration.GENERAL, setting.n, rng)
    xy1, xy2 = (xy + rng.normal(0.0, setting.sigma_px, xy.shape) for xy in (scene.xy1, scene.xy2))
    right = np.ones(setting.n, dtype=bool)
    right[: round(setting.wrong * setting.n)] = False
    xy2[~right] = rng.uniform((0.0, 0.0), SIZE, (int(np.sum(~right)), 2))
    bound = fundamental_bound(scene.P1, scene.P2, scene.X[right], sigma_px=setting.sigma_px)
    return Trial(xy1, xy2, scene.xy1[right], scene.xy2[right], bound.rms_distance_px)


def measure(method: Method, trials: Sequence[Trial], setting: Setting, *, told: bool = False) -> Result:
    """One method over the trials of one setting, after two calls that do not count."""
    threshold = TOLD_SIGMAS * setting.sigma_px if told else THRESHOLD_PX
    ratios, seconds = [], []
    for seed in (-2, -1, *range(len(trials))):
        trial = trials[max(seed, 0)]
        start = time.process_time()
        F = method.fundamental(trial.xy1, trial.xy2, threshold_px=threshold, seed=max(seed, 0))
        elapsed = time.process_time() - start
        if seed >= 0:
            seconds.append(elapsed)
            if F is not None:
                ratios.append(trial.ratio(F))
    good = np.array(ratios) if ratios else np.array([np.inf])
    return Result(
        method.name,
        setting,
        told,
        float(np.sqrt(np.mean(good**2))),
        float(np.median(good)),
        1e3 * float(np.median(seconds)),
        len(trials) - len(ratios),
        len(trials),
    )


def run_study(settings: Sequence[Setting], methods: Sequence[Method], trials: int) -> list[Result]:
    """All methods in all settings; thresholded ones twice, with the default and with 3 sigma.

    Where there are wrong matches only the robust methods take part.
    """
    one_thread()
    results: list[Result] = []
    for setting in settings:
        data = [make_trial(setting, seed) for seed in range(trials)]
        for method in methods:
            if setting.wrong and not method.robust:
                continue
            results.append(measure(method, data, setting))
            if method.thresholded:
                results.append(measure(method, data, setting, told=True))
        print(f"done: {setting}", flush=True)
    return results


def ratio_table(results: Sequence[Result]) -> str:
    """RMS ratio (median ratio; trials without F) of each method in each setting, as Markdown."""
    return _table(results, lambda s: f"{s.sigma_px:g} px, {s.n}", _ratio_cell)


def time_table(results: Sequence[Result]) -> str:
    """Median milliseconds of each method by the number of matches, at 1 px or else the least noise."""
    sigmas = {r.setting.sigma_px for r in results}
    sigma = 1.0 if 1.0 in sigmas else min(sigmas)
    some = [r for r in results if r.setting.sigma_px == sigma]
    return _table(some, lambda s: f"n = {s.n}", lambda r: f"{r.time_ms:.3g}")


def _ratio_cell(r: Result) -> str:
    failed = f"; {r.failures} none" if r.failures else ""
    return f"{_short(r.rms_ratio)} ({_short(r.median_ratio)}{failed})"


def _short(value: float) -> str:
    return f"{value:.2f}" if value < 10.0 else f"{value:.0f}"


def _table(results: Sequence[Result], head: Callable[[Setting], str], cell: Callable[[Result], str]) -> str:
    settings = list(dict.fromkeys(r.setting for r in results))
    labels = list(dict.fromkeys(r.label for r in results))
    cells = {(r.label, r.setting): cell(r) for r in results}
    lines = [f"| | {' | '.join(map(head, settings))} |", f"| --- |{' --- |' * len(settings)}"]
    for label in labels:
        lines.append(f"| {label} | {' | '.join(cells.get((label, s), '-') for s in settings)} |")
    return "\n".join(lines)


def report(results: Sequence[Result]) -> str:
    """The tables without and with wrong matches, as Markdown."""
    blocks = []
    for wrong in sorted({r.setting.wrong for r in results}):
        some = [r for r in results if r.setting.wrong == wrong]
        title = f"{100.0 * wrong:.0f} % wrong matches, {some[0].trials} trials"
        blocks.append(f"{title}: RMS (median) of the distance over the bound\n\n{ratio_table(some)}")
        blocks.append(f"{title}: median processor time, ms\n\n{time_table(some)}")
    return "\n\n".join(blocks)


def read_results(path: Path) -> list[Result]:
    """The results of an earlier run, from its JSON."""
    rows = json.loads(path.read_text(encoding="utf-8"))["results"]
    return [Result(**{**row, "setting": Setting(**row["setting"])}) for row in rows]


def write_results(path: Path, results: Sequence[Result]) -> None:
    """Results with the machine and the versions they come from, as JSON."""
    made = {
        "machine": platform.machine(),
        "python": platform.python_version(),
        "opencv": version(PACKAGES["cv2"]),
        "poselib": version("poselib"),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"made_with": made, "results": [asdict(r) for r in results]}
    write_text(path, json.dumps(content, indent=1))


def merged(old: Sequence[Result], new: Sequence[Result]) -> list[Result]:
    """``old`` with ``new`` in the place of the same rows, in the order of the settings and the catalogue."""
    rows = {(r.label, r.setting): r for r in (*old, *new)}
    place = {m.name: k for k, m in enumerate(METHODS)}

    def order(r: Result) -> tuple[float, ...]:
        s = r.setting
        return s.wrong, s.sigma_px, s.n, place.get(r.method, len(place)), r.told

    return sorted(rows.values(), key=order)


def main() -> int:
    """Print the tables; 1 where the gold standard or the default misses 1.05 without wrong matches."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--points", type=int, nargs="+", default=[30, 100, 1000])
    parser.add_argument("--noise", type=float, nargs="+", default=[0.5, 1.0, 2.0])
    parser.add_argument(
        "--wrong", type=float, nargs="+", default=[0.0, WRONG], help="shares of wrong matches"
    )
    parser.add_argument("--methods", nargs="+", choices=[m.name for m in METHODS], metavar="NAME")
    parser.add_argument("-o", "--out", type=Path, help="JSON; rows that are already there are renewed")
    arguments = parser.parse_args()
    methods = [m for m in METHODS if arguments.methods is None or m.name in arguments.methods]
    settings = [
        Setting(sigma, n, wrong)
        for wrong in arguments.wrong
        for sigma in ([WRONG_NOISE_PX] if wrong else arguments.noise)
        for n in arguments.points
    ]
    results = read_results(arguments.out) if arguments.out and arguments.out.exists() else []
    judged = []
    for setting in settings:
        block = run_study([setting], methods, arguments.trials)
        judged += [r for r in block if r.method in (GOLD, DEFAULT) and not (r.told or setting.wrong)]
        results = merged(results, block)
        if arguments.out:
            write_results(arguments.out, results)
    print(report(results))
    return int(any(r.rms_ratio > ALLOWED for r in judged))


if __name__ == "__main__":
    raise SystemExit(main())
