"""Ablations: swap any variant or parameter of any stage, over scenes and seeds, and get an answer with its
uncertainty.

    rows = ablate(Study({"epipolar.threshold_px": [0.5, 1.0, 2.0]}, ["courtyard"]), "out")
    print(analyse(rows))
"""

from validation.ablation.analysis import analyse, compare_runs
from validation.ablation.page import write_analysis
from validation.ablation.run import Row, Rows, ablate, read_rows
from validation.ablation.study import Measure, Place, Study

__all__ = [
    "Measure",
    "Place",
    "Row",
    "Rows",
    "Study",
    "ablate",
    "analyse",
    "compare_runs",
    "read_rows",
    "write_analysis",
]
