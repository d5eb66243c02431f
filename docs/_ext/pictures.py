"""Pictures of the pages, drawn when the site is built."""

from __future__ import annotations

import ast
import os
from pathlib import Path

from _ext import overview
from _ext.code import ROOT

BLUE, RED, GREY = "#2b6cb0", "#c53030", "#555555"


def draw_axes(path: Path) -> None:
    """The frames of world and camera, and the projection of a point."""
    import matplotlib.pyplot as plt
    import numpy as np

    figure, ax = plt.subplots(figsize=(7.2, 3.4))
    centre, plane = np.array([0.0, 0.0]), 2.2
    point = np.array([5.2, -1.3])
    for end, place, name in (
        ((1.3, 0.0), (1.2, 0.2), "z"),
        ((0.0, -1.3), (0.0, -1.5), "y"),
        ((-0.75, -0.55), (-0.84, -0.64), "x"),
    ):
        ax.annotate("", end, centre, arrowprops={"arrowstyle": "->", "color": BLUE, "lw": 2})
        ax.text(*place, name, color=BLUE, ha="center", va="center", fontsize=12)
    ax.text(-0.15, 0.28, "camera centre\n$-R^T t$", ha="center", va="bottom", color=BLUE)
    ax.plot([plane, plane], [-1.1, 1.1], color=GREY, lw=2)
    ax.text(plane, 1.2, "image (distance: focal length)", ha="center", color=GREY)
    ax.plot([0, point[0]], [0, point[1]], color=RED, lw=1.2)
    ax.plot([0, 6.2], [0, 0], color=GREY, lw=0.8, ls="--")
    ax.text(4.6, 0.1, "optical axis: depth is z", color=GREY)
    ax.plot(*point, "o", color=RED)
    ax.text(point[0] + 0.12, point[1], "X (world)", color=RED, va="center")
    hit = point * plane / point[0]
    ax.plot(*hit, "o", color=RED)
    ax.text(hit[0] + 0.1, hit[1] - 0.55, "x ~ K [R t] X", color=RED)
    world = np.array([4.3, 1.0])
    for end, name in (((0.8, 0.0), "X"), ((0.0, 0.8), "Y"), ((-0.45, -0.3), "Z")):
        ax.annotate("", world + end, world, arrowprops={"arrowstyle": "->", "color": "black", "lw": 1.5})
        ax.text(*(world + np.array(end) * 1.25), name, ha="center", va="center")
    ax.text(world[0] + 0.9, world[1] + 0.62, "world: any frame,\nR takes it to the camera", va="center")
    ax.set(xlim=(-1.3, 7.6), ylim=(-1.75, 2.1), aspect="equal")
    ax.axis("off")
    save(figure, path)


def draw_pixels(path: Path) -> None:
    """The top-left pixels of an image, with their coordinates here and in COLMAP."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(7.2, 3.1))
    labels = (("thesisrecon and OpenCV", 0.0, BLUE), ("COLMAP", 0.5, RED))
    for ax, (title, shift, colour) in zip(axes, labels, strict=True):
        for k in range(5):
            ax.plot([k - 0.5, k - 0.5], [-0.5, 2.5], color=GREY, lw=0.8)
        for k in range(4):
            ax.plot([-0.5, 3.5], [k - 0.5, k - 0.5], color=GREY, lw=0.8)
        for x in range(4):
            for y in range(3):
                ax.plot(x, y, ".", color=GREY, ms=4)
        for x, y in ((0, 0), (3, 0), (0, 2)):
            ax.plot(x, y, "o", color=colour)
            ax.text(x, y + 0.3, f"({x + shift:g}, {y + shift:g})", color=colour, ha="center", fontsize=8)
        ax.plot(-shift, -shift, "x", color="black", ms=9, mew=2)
        ax.annotate("", (1.3, -0.75), (-0.5, -0.75), arrowprops={"arrowstyle": "->"}, annotation_clip=False)
        ax.text(1.4, -0.75, "x", va="center")
        ax.annotate("", (-0.75, 1.3), (-0.75, -0.5), arrowprops={"arrowstyle": "->"}, annotation_clip=False)
        ax.text(-0.75, 1.45, "y", ha="center", va="top")
        ax.set(xlim=(-1, 3.7), ylim=(2.7, -1.0), aspect="equal")
        ax.set_title(f"{title} (x: the origin)", fontsize=10, color=colour)
        ax.axis("off")
    save(figure, path)


def draw_chain(path: Path) -> None:
    """The transforms from a world point to a pixel of the original image."""
    import matplotlib.pyplot as plt

    figure, ax = plt.subplots(figsize=(8.4, 1.7))
    boxes = (
        ("world\nX", "R X + t"),
        ("camera\n(x, y, z)", "x/z, y/z"),
        ("normalised\n(x, y)", "1 + k1 r²\n+ k2 r⁴ + k3 r⁶"),
        ("distorted\n(x, y)", "K"),
        ("pixel (u, v)\nof the original", ""),
    )
    for k, (name, step) in enumerate(boxes):
        ax.text(
            2.6 * k, 0, name, ha="center", va="center", fontsize=9,
            bbox={"boxstyle": "round,pad=0.5", "fc": "#e8f0fa", "ec": BLUE},
        )  # fmt: skip
        if step:
            ax.annotate("", (2.6 * k + 1.65, 0), (2.6 * k + 0.95, 0), arrowprops={"arrowstyle": "->"})
            ax.text(2.6 * k + 1.3, 0.42, step, ha="center", va="bottom", fontsize=8, color=RED)
    ax.set(xlim=(-1.0, 11.6), ylim=(-0.6, 1.1))
    ax.axis("off")
    save(figure, path)


def imports_between_parts() -> dict[str, set[str]]:
    """The parts of the package (folders and files) that each part imports, but not for types alone."""
    package = ROOT / "thesisrecon"
    found: dict[str, set[str]] = {}
    for path in sorted(package.rglob("*.py")):
        part = path.relative_to(package).parts[0].removesuffix(".py")
        tree = ast.parse(path.read_text(encoding="utf-8"))
        typing = [n for n in ast.walk(tree) if isinstance(n, ast.If) and "TYPE_CHECKING" in ast.dump(n.test)]
        skipped = {id(n) for block in typing for n in ast.walk(block)}
        nodes = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and id(n) not in skipped]
        names = {n.module.split(".")[1] for n in nodes if (n.module or "").startswith("thesisrecon.")}
        found.setdefault(part, set()).update(names - {part})
    return {part: names & found.keys() for part, names in found.items() if part != "__init__"}


def layers_of(imports: dict[str, set[str]]) -> list[list[str]]:
    """Parts by layer: each imports only layers before its own; parts that import each other share one."""
    reached = {part: {part} | names for part, names in imports.items()}
    for _ in imports:
        reached = {part: set().union(*(reached[n] for n in names)) for part, names in reached.items()}
    below = {part: {n for n in names if part not in reached[n]} for part, names in reached.items()}
    layers: list[list[str]] = []
    while left := [part for part in imports if not any(part in layer for layer in layers)]:
        layers.append([part for part in left if not below[part] & set(left)])
    return layers


def draw_layers(path: Path) -> None:
    """The parts of the package, each above what it imports, and lines to the imports of the next layer."""
    import matplotlib.pyplot as plt

    imports = imports_between_parts()
    layers = layers_of(imports)
    figure, ax = plt.subplots(figsize=(9.5, 0.75 * len(layers)))
    place = {}
    for row, layer in enumerate(layers):
        folders = sorted(layer, key=lambda part: (not (ROOT / "thesisrecon" / part).is_dir(), part))
        # A wide layer is drawn in two lines, so that names do not cover each other.
        lines = (0.0, 0.4) if len(folders) > 7 else (0.0,)
        for k, part in enumerate(folders):
            place[part] = ((k + 0.5) / len(folders), row + lines[k % len(lines)])
    for part, (x, y) in place.items():
        folder = (ROOT / "thesisrecon" / part).is_dir()
        for other in imports[part]:
            below = place[other][1]
            if int(below) == int(y) - 1:
                ax.plot([x, place[other][0]], [y, below], color="#bbbbbb", lw=0.7, zorder=0)
        fill, edge = ("#e8f0fa", BLUE) if folder else ("white", GREY)
        box = {"boxstyle": "round,pad=0.35", "fc": fill, "ec": edge}
        ax.text(x, y, f"{part}/" if folder else part, ha="center", va="center", fontsize=7, bbox=box)
    ax.set(xlim=(0, 1), ylim=(-0.5, len(layers) - 0.5))
    ax.axis("off")
    save(figure, path)


def save(figure, path: Path) -> None:
    """Write a figure on white, which is legible on dark pages too."""
    import matplotlib.pyplot as plt

    figure.savefig(path, dpi=160, bbox_inches="tight", facecolor="white")
    plt.close(figure)


DRAWINGS = {
    "axes.png": draw_axes,
    "pixels.png": draw_pixels,
    "transforms.png": draw_chain,
    "layers.png": draw_layers,
}


def make_all(app) -> None:
    """Make the pictures; without the tutorial, the first page shows the input images only."""
    folder = Path(app.srcdir) / "pictures"
    folder.mkdir(exist_ok=True)
    for name, draw in DRAWINGS.items():
        draw(folder / name)
    whole, made = folder / "overview.jpg", folder / ".overview-of-the-code"
    if os.environ.get("DOCS_GALLERY") == "0":
        if not whole.is_file():
            overview.draw_input().save(whole)
    elif not made.is_file():
        overview.draw_overview(whole)
        made.touch()


def setup(app):
    """Draw before the sources are read."""
    app.connect("builder-inited", make_all)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
