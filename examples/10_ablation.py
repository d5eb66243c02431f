r"""
10. Which part of the method matters? An ablation
=================================================

To know whether a part of a method is needed, replace it, keep the rest, and compare on the same data: an
ablation. Errors vary from :term:`draw` to draw, so all variants get the same draws, many of them, and the
mean ratio of their errors is reported with a 95 % interval. Only an interval without 1 shows a difference.
Here the fundamental matrix (chapter 5) of pairs of the cube is estimated from matches with 0.5 px of noise,
30 % of them wrong. The error is the RMS distance of exact points to their epipolar lines.

The variants: another threshold; the search of the thesis (Algorithm 2: random samples of seven matches, the
largest set of :term:`inliers <inlier>` wins); least median of squares, which needs no threshold; and, as an
example of a method of your own, no search at all. Any object with the method of its stage can be a variant.
"""

from dataclasses import dataclass, replace
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt

import thesisrecon
from validation.ablation import Study, ablate, analyse
from validation.ablation.analysis import as_reported
from validation.ablation.tasks.synthetic import FundamentalOfCube


@dataclass(frozen=True)
class EveryMatch:
    def estimate(self, xy1, xy2, rng):
        return thesisrecon.estimate_fundamental(xy1, xy2, method="gold-standard")


default = thesisrecon.PipelineConfig().epipolar
variants = [replace(default, threshold_px=4.0), "thesis-ransac", EveryMatch()]
task = FundamentalOfCube(pairs=4, noise_px=0.5, outliers=0.3)
study = Study({"epipolar": variants}, ["cube"], seeds=8, task=task, metrics=["distance_px"])
with TemporaryDirectory() as folder:
    report = analyse(ablate(study, folder))
print(report)

# %%
# The same as a picture, with a logarithmic scale. Without a search, the wrong matches spoil the result, since
# a least-squares estimate uses all of them. Studies of whole stages run from files:
# ``python -m validation ablate``.

figure, axis = plt.subplots(figsize=(9, 3.2), layout="constrained")
for row, one in enumerate(report.comparisons):
    middle, low, high = as_reported(one)
    axis.errorbar(middle, row, xerr=[[middle - low], [high - middle]], fmt="o", capsize=4)
axis.axvline(1.0, color="k", linestyle="--")
axis.set(xscale="log", xlabel="error over that of the default (ratio, 95 % interval)")
names = [one.variant.replace(", ", "\n") for one in report.comparisons]
axis.set_yticks(range(len(names)), names)
