"""Every failure, warning and failed check of the package, with cause and remedy, read from its source.

A message is a template: "…" stands for a value. The advice of a ``StageFailure`` stands in the code; that of
the other messages stands in `remedies.toml`, which has an entry for each.
"""

from __future__ import annotations

import ast
import re
import tomllib
from itertools import product
from pathlib import Path
from typing import Any

from _ext.code import PACKAGE, summary, tree_of, write

REMEDIES = Path(__file__).with_name("remedies.toml")
SOURCES = {
    "Images that are left out": {
        "io/_images.py": ("read_images", "_read", "decode_file", "_too_large", "_decoded_image"),
        "io/_pixels.py": ("resized_to", "opaque_part"),
        "io/_raw_files.py": ("RAW_FILE", "refuse_raw_file"),
        "io/_masks.py": ("find_masks", "USELESS_MASKS"),
        "io/_frames.py": ("_decoded",),
        "pipeline/reconstruction.py": ("_read_inputs", "_refusals", "_exif_warnings"),
        "pipeline/_matching_stages.py": ("finish_features",),
    },
    "Images that are not registered": {
        "projective/incremental.py": (
            "OUTSIDE_CORE", "add_next_camera", "_try_camera", "_covariance_test", "_discard_camera",
        ),
        "records.py": ("with_reasons",),
        "metric/_resection.py": ("_register_missing", "_register", "_register_again"),
        "pipeline/_steps.py": ("_with_group_reasons",),
    },
    "Pairs of images": {
        "epipolar/verification.py": ("_objection", "_assess_pair"),
        "pipeline/_matching_stages.py": ("_degenerate_pairs",),
        "pipeline/_steps.py": ("_run_groups",),
    },
    "Calibration": {
        "pipeline/_outputs.py": ("_failure_warnings",),
        "numerics/_identifiability.py": (
            "_failure", "_resolution", "identifiability_sentences", "excess_noise",
        ),
        "metric/refinement.py": ("_contradiction",),
        "metric/_shared_camera.py": (
            "_focals_differ", "_centres_differ", "_untestable", "contradicted_focal_priors",
            "inconsistent_principal_point", "focal_decided_by_model",
        ),
        "metric/_camera_model.py": ("differences_of_images",),
        "metric/_uncertainty.py": ("warnings",),
    },
    "The self-check": {"metric/_checks.py": ("_failed_join", "_failed_model", "_failed_views")},
    "Results and files": {
        "pipeline/_stages.py": ("reconstruct_metric", "estimate_depth_maps"),
        "pipeline/_steps.py": ("_run_all",),
        "pipeline/_outputs.py": ("_write_model", "write_outputs"),
        "runtime/_run.py": ("_loaded",),
        "errors.py": ("made",),
    },
}  # fmt: skip
"""Functions and constants whose sentences are warnings, failed checks or reasons against an image."""
PASSED_ON = {
    "cli/compare.py", "cli/view_files.py", "pipeline/_loading.py", "pipeline/from_matches.py",
    "runtime/_run_folder.py", "metric/refinement.py",
    "report/_page.py", "report/_data.py", "records.py", "results.py", "cli/main.py",
}  # fmt: skip
"""Files that only pass warnings on."""
FOLDERS = (
    "pipeline", "io", "matching", "epipolar", "geometry", "projective", "selfcalibration", "metric", "stereo",
    "surface", "views", "",
)  # fmt: skip


def functions_of(path: Path) -> list[ast.FunctionDef]:
    """All functions and methods of a file."""
    return [node for node in ast.walk(tree_of(path)) if isinstance(node, ast.FunctionDef)]


def texts(node: ast.expr | None, names: dict[str, list[ast.expr]], depth: int = 0) -> list[str]:
    """Return the texts that an expression may have; "…" for a value."""
    if node is None:
        return [""]
    if isinstance(node, ast.Constant):
        return [str(node.value)] if isinstance(node.value, str) else ["…"]
    if isinstance(node, ast.JoinedStr):
        parts = [
            texts(v.value if isinstance(v, ast.FormattedValue) else v, names, depth + 1) for v in node.values
        ]
        return ["".join(chosen) for chosen in product(*parts)][:12]
    if isinstance(node, ast.IfExp):
        return texts(node.body, names, depth) + texts(node.orelse, names, depth)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return [a + b for a, b in product(texts(node.left, names, depth), texts(node.right, names, depth))]
    if isinstance(node, ast.Name) and node.id in names and depth < 3:
        found = [text for value in names[node.id] for text in texts(value, names, depth + 1)]
        return found if any(any(c.isalpha() for c in text) for text in found) else ["…"]
    return ["…"]


def assigned(scope: ast.AST) -> dict[str, list[ast.expr]]:
    """Names and the expressions that are assigned to them, also of tuples."""
    found: dict[str, list[ast.expr]] = {}
    for node in ast.walk(scope):
        if isinstance(node, ast.Assign):
            for target in node.targets:
                pairs = [(target, node.value)]
                if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                    pairs = list(zip(target.elts, node.value.elts, strict=True))
                for name, value in pairs:
                    if isinstance(name, ast.Name):
                        found.setdefault(name.id, []).append(value)
    return found


def stage_failures() -> dict[str, list[tuple[str, str, str]]]:
    """Return (reason, evidence, advice) of every failure by folder, without those that are passed on."""
    found: dict[str, list[tuple[str, str, str]]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        constants = {k: v for k, v in assigned(tree_of(path)).items() if k.isupper() or k.startswith("_")}
        folder = path.relative_to(PACKAGE).parts[0] if path.parent != PACKAGE else ""
        inner = [(function, function) for function in functions_of(path)]
        seen: set[int] = set()
        for function, scope in reversed(inner):
            names = constants | assigned(scope)
            for node in ast.walk(function):
                if (
                    not isinstance(node, ast.Call)
                    or ast.unparse(node.func) != "StageFailure"
                    or id(node) in seen
                ):
                    continue
                seen.add(id(node))
                given = dict(zip(("reason", "evidence", "advice"), node.args, strict=False))
                given |= {word.arg: word.value for word in node.keywords}
                if isinstance(given["reason"], ast.Starred | ast.Attribute):
                    continue
                evidence, advice = (joined(given.get(word), names) for word in ("evidence", "advice"))
                # A reason that is a value alone is one of another table, passed on.
                for reason in (r for r in texts(given["reason"], names) if any(c.isalpha() for c in r)):
                    found.setdefault(folder, []).append((reason, evidence, advice))
    return {folder: sorted(set(rows)) for folder, rows in found.items()}


def joined(node: ast.expr | None, names: dict[str, list[ast.expr]]) -> str:
    """All texts of an expression in one."""
    return " / ".join(dict.fromkeys(texts(node, names))).strip()


def sentences(path: Path, names: tuple[str, ...]) -> list[str]:
    """Return the sentences within functions of a file; parts of sentences and of failures are left out."""
    constants = assigned(ast.Module([n for n in tree_of(path).body if isinstance(n, ast.Assign)], []))
    found = [text for name in names if name in constants for text in texts(constants[name][0], {})]
    for function in functions_of(path):
        if function.name not in names:
            continue
        skipped = {id(part) for node in ast.walk(function) if is_left_out(node) for part in ast.walk(node)}
        inner = {id(v) for n in ast.walk(function) if isinstance(n, ast.JoinedStr) for v in ast.walk(n)}
        for node in ast.walk(function):
            text = texts(node, {})[0] if isinstance(node, ast.Constant | ast.JoinedStr) else ""
            own = id(node) not in inner or isinstance(node, ast.JoinedStr)
            if own and id(node) not in skipped and text.count(" ") >= 2 and text[0] not in " ,;:":
                found.append(text)
    return sorted(set(found))


def is_left_out(node: ast.AST) -> bool:
    """Is a node a docstring, an error, or something that is assigned for one?"""
    if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
        return ast.unparse(node.exc.func) in ("StageFailure", "UsageError", "ValueError")
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def warning_sinks() -> set[str]:
    """Files with code that makes or passes on warnings."""
    found = set()
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(tree_of(path)):
            if (
                isinstance(node, ast.Name | ast.Attribute) and ast.unparse(node).split(".")[-1] == "warnings"
            ) or (isinstance(node, ast.keyword) and node.arg == "warnings"):
                found.add(str(path.relative_to(PACKAGE)))
    return found


def reason_sinks() -> set[str]:
    """Files that set the reason why an image is not registered."""
    found = set()
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(tree_of(path)):
            target = node.targets[0] if isinstance(node, ast.Assign) else None
            if isinstance(target, ast.Subscript) and re.search(
                r"\b(reasons|rejected)$", ast.unparse(target.value)
            ):
                found.add(str(path.relative_to(PACKAGE)))
    return found


def remedies() -> dict[str, Any]:
    """Return message -> cause and remedy, "failures" -> reason -> remedy, and "parts" of other messages."""
    return tomllib.loads(REMEDIES.read_text(encoding="utf-8"))


def messages() -> dict[str, list[str]]:
    """Return the messages of `SOURCES` by title."""
    parts = remedies()["parts"]["of"]
    found = {
        title: {text for file, names in files.items() for text in sentences(PACKAGE / file, names)}
        for title, files in SOURCES.items()
    }
    return {title: sorted(texts - set(parts), key=str.lower) for title, texts in found.items()}


def page() -> str:
    """Return the page of all failures and warnings."""
    known, lines = remedies(), [HEAD]
    for title, found in messages().items():
        lines += [f"### {title}", "", "| message | cause and remedy |", "| --- | --- |"]
        lines += [f"| {cell(text)} | {cell(known.get(text, ''))} |" for text in found]
        lines.append("")
    lines += [FAILURES]
    failures = stage_failures()
    for folder in sorted(failures, key=lambda name: FOLDERS.index(name)):
        title = (
            summary(PACKAGE / folder / "__init__.py").rstrip(".") if folder else "Functions of plain arrays"
        )
        lines += [f"### {title}", "", "| reason | evidence | what to do |", "| --- | --- | --- |"]
        for reason, evidence, advice in failures[folder]:
            what_to_do = advice if any(c.isalpha() for c in advice) else known["failures"].get(reason, "")
            lines.append(f"| {cell(reason)} | {cell(evidence)} | {cell(what_to_do)} |")
        lines.append("")
    return "\n".join(lines)


def cell(text: str) -> str:
    """Text for a cell of a table."""
    return " ".join(text.split()).replace("|", r"\|")


HEAD = """# When a run fails or warns

This page is made from the code, so it holds every message; "…" stands for a value. Search it for a
few words of your message.

A run ends in one of four ways:

- `"trusted": true` in `summary.json`: all checks passed. Read the warnings all the same.
- `"trusted": false`: cameras and points are written, and `failed_checks` names what is wrong with them.
- A failure, exit code 3: the images cannot be reconstructed. The report and `summary.json` are written up to
  the last stage that finished, and the message says what was measured and what to do. In Python it is a
  {py:class}`~thesisrecon.StageFailure` with `reason`, `evidence` and `advice`.
- Wrong options or settings, exit code 2 ({py:class}`~thesisrecon.UsageError`): the message names the rule and
  what to do; nothing was computed.

Most failures are caused by the images: too little overlap, no sideways motion, or one of the {term}`critical
motions <critical motion>` of [how to take good images](photographing.md).

**Why one image is missing**: see `report.html`, table "Images", or in Python `result.refused` (name ->
reason). An image is *left out* if it cannot be read or used at all ([reasons](#images-that-are-left-out)),
and *not registered* if it was read but has no camera in the model
([reasons](#images-that-are-not-registered)). This does not affect the rest of the model.

## Warnings and failed checks
"""
FAILURES = """## Failures

A failure says what happened (reason), what was measured (evidence) and what to do. "/" separates variants.
Two different images suffice for matching; a calibration needs three
([why](photographing.md#why-three-views)). Functions of two images (`rectify`, `draw_epipolar_lines` and
others) refuse a file that cannot be read with the reasons of the first table.

"""


def setup(app):
    """Write the page before the sources are read."""
    app.connect("builder-inited", lambda app: write(Path(app.srcdir) / "start" / "failures.md", page()))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
