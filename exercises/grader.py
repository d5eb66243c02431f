"""Grade solutions of the exercises: the accuracy, and the mistake that explains a wrong result.

``NAME.py`` is a problem with a skeleton, ``solutions/NAME.py`` solves it, and ``checks/NAME.py`` has

- ``RETURNS``: name and shape of each returned array (None: any number; a letter: the same everywhere),
- ``data(rng)``: a namespace with ``inputs``, the arguments, and the truth,
- ``error(output, case)`` in ``UNIT``; a solution passes up to ``LIMIT`` (1.25) times the error of ours,
- ``MISTAKES``: sentence -> function of the right solution and the inputs that returns a wrong result.

Optional are ``ours(case)``, the result of the library; ``bound(case)``, the least error; ``vector(output,
case)``, the numbers in which results are compared; ``faults(output, case)``, sentences on what is not
fulfilled; ``seen(output, case)``, the same from what the function called; ``FLOOR``, an error that always
passes; ``CASES``, the number of data sets.

A wrong result is compared with those of all mistakes. If none is equal, a change of the results or of the
arguments that makes it right, and arguments that do not matter, are searched (``causes.py``), then results of
the solution with one expression of its source changed (``variants.py``). The nearest, if near, is named.
"""

import ast
import copy
import importlib
import importlib.util
import inspect
import signal
import sys
import time
import traceback
import warnings
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
CLOSE = 0.35
"""A mistake is named up to this distance from its result, as a share of its distance from the right one."""


EQUAL = 0.05
"""A changed expression of the solution is named up to this distance."""
SECONDS = 10.0
"""Processor time for the results of changed expressions."""


class Refused(Exception):
    """A solution that cannot be graded; the message says why."""


def titles():
    """Name -> title of all exercises in their order."""
    found = {}
    for path in HERE.glob("*.py"):
        first = (ast.get_docstring(ast.parse(path.read_text("utf-8"))) or "").split("\n")[0]
        if first[:1].isdigit():
            found[path.stem] = first
    return dict(sorted(found.items(), key=lambda item: int(item[1].split(".")[0])))


def solution(name):
    """The function that solves an exercise."""
    return getattr(importlib.import_module(f"solutions.{name}"), name)


def read(path, name):
    """The function ``name`` of a file."""
    spec = importlib.util.spec_from_file_location("student", path)
    module = importlib.util.module_from_spec(spec)
    # Its own helper modules are beside it.
    sys.path.append(str(Path(path).resolve().parent))
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        raise Refused(f"line {error.lineno} is not Python: {error.msg}") from None
    except (Exception, SystemExit) as error:
        raise Refused(f"the file cannot be loaded: {_raised(error, path)}") from None
    function = getattr(module, name, None)
    if not callable(function):
        others = [key for key, value in vars(module).items() if inspect.isfunction(value)]
        named = f"; it defines {', '.join(others)}" if others else ""
        raise Refused(f"the file defines no function {name}{inspect.signature(solution(name))}{named}")
    return function


def _raised(error, path=None):
    """Type, line and message of an exception; the line is the last one in the given file."""
    lines = [
        line for frame, line in traceback.walk_tb(error.__traceback__)
        if path is None or Path(frame.f_code.co_filename) == Path(path)
    ]  # fmt: skip
    where = f" in line {lines[-1]}" if lines else ""
    return f"{type(error).__name__}{where}{': ' if str(error) else ''}{error}"


def _called(name, function, inputs, path):
    """The result of a solution; its arguments are copies."""
    given = copy.deepcopy(inputs)
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            return function(*given)
    except NotImplementedError:
        raise Refused(
            f"{name} is not written yet: put your code in place of `raise NotImplementedError`"
        ) from None
    except (Exception, SystemExit) as error:
        raise Refused(f"{name} raised {_raised(error, path)}") from None


def checked(name, output, returns):
    """The returned arrays; a sentence if their number, shape or type is wrong."""
    if output is None:
        raise Refused(
            f"{name} returns None: the last line must be `return {', '.join(n for n, _ in returns)}`"
        )
    if len(returns) == 1:
        output = (output,)
    elif not isinstance(output, tuple | list) or len(output) != len(returns):
        got = f"{len(output)} values" if isinstance(output, tuple | list) else type(output).__name__
        raise Refused(
            f"{name} returns {got}, not the {len(returns)} values {', '.join(n for n, _ in returns)}"
        )
    found, letters = [], {}
    for value, (label, shape) in zip(output, returns, strict=True):
        try:
            array = np.asarray(value)
        except ValueError:
            raise Refused(f"{label} is not an array: its rows have different lengths") from None
        if array.dtype.kind not in "biuf":
            kind = "complex" if array.dtype.kind == "c" else f"of type {array.dtype}"
            raise Refused(f"{label} is {kind}; it must be real numbers")
        expected = str(tuple(shape)).replace("'", "").replace("None", "N")
        if array.ndim != len(shape) or not all(
            letters.setdefault(n, size) == size if isinstance(n, str) else n in (None, size)
            for n, size in zip(shape, array.shape, strict=True)
        ):
            turned = array.ndim > 1 and array.shape[::-1] == tuple(
                letters.get(n, size) if isinstance(n, str) or n is None else n
                for n, size in zip(shape, array.shape[::-1], strict=False)
            )
            hint = " (transposed?)" if turned and len(shape) == array.ndim else ""
            raise Refused(f"{label} has the shape {array.shape}, not {expected}{hint}")
        if not np.isfinite(array).all():
            raise Refused(
                f"{label} contains NaN or infinity: a division by zero, or a logarithm or root below 0?"
            )
        found.append(array)
    return found[0] if len(returns) == 1 else tuple(found)


def up_to_scale(*arrays):
    """Each array with unit norm and a positive sum of cubes, so that scale and sign do not count."""
    out = []
    for array in arrays:
        v = np.ravel(array).astype(float)
        v = v / max(np.linalg.norm(v), 1e-300)
        out.append(v * (np.sign((v**3).sum()) or 1.0))
    return np.concatenate(out)


def _vector(check, output, case):
    if hasattr(check, "vector"):
        return check.vector(output, case)
    arrays = output if isinstance(output, tuple) else (output,)
    return np.concatenate([np.ravel(array).astype(float) for array in arrays])


def _distance(a, b):
    """Distance of two results; sets (2D) are compared by their farthest member."""
    if a.ndim == 1:
        return float(np.linalg.norm(a - b)) if a.shape == b.shape else np.inf
    apart = np.linalg.norm(a[:, None] - b[None], axis=2)
    return float(max(apart.min(axis=0).max(), apart.min(axis=1).max()))


def _rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def _ratio(check, change, output, good, case):
    """Distance of an output from the result of a mistake, as a share of that result's from the right one."""
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            wrong = checked("", change(*copy.deepcopy(case.inputs)), check.RETURNS)
            wrong, good, own = (_vector(check, one, case) for one in (wrong, good, output))
            # A result of zeros is near all small results.
            scale = min(_distance(good, wrong), _distance(0 * wrong, wrong) or np.inf)
            ratio = _distance(own, wrong) / scale
    except Exception:  # a change may break the solution in any way
        return np.inf
    return ratio if np.isfinite(ratio) else np.inf


def _mistake(name, check, outputs, right, cases, *, cause, known):
    """The sentence that explains wrong results, or None.

    ``cause`` makes one that is in no table; if faults are ``known``, expressions are not changed.
    """
    every = list(zip(outputs, right, cases, strict=True))
    off = [_distance(_vector(check, o, case), _vector(check, g, case)) for o, g, case in every]
    wrong = [one for one, far in zip(every, off, strict=True) if far > 1e-3 * max(off)]
    table = {
        sentence: [_ratio(check, lambda *given, of=change: of(check.solve, *given), *one) for one in wrong]
        for sentence, change in check.MISTAKES.items()
    }
    if (sentence := _listed(table, EQUAL) or cause()) is not None or known:
        return sentence
    return _changed_expression(name, check, wrong) or _listed(table, CLOSE)


def _listed(table, limit):
    """The mistake of the table nearest to the results, or None if none is within a limit."""
    nearest = min(table, key=lambda sentence: np.median(table[sentence]), default=None)
    if nearest is None or np.median(table[nearest]) < limit:
        return nearest
    # Chance may choose another one of several mistakes in each data set.
    count = len(table[nearest])
    best = [min(table, key=lambda sentence, k=k: table[sentence][k]) for k in range(count)]
    if any(table[sentence][k] >= limit for k, sentence in enumerate(best)):
        return None
    kinds = {sentence.split(":")[0] for sentence in best}
    return kinds.pop() if len(kinds) == 1 else Counter(best).most_common(1)[0][0]


@contextmanager
def _limited():
    """Stop a variant that does not end, such as a search that diverges."""

    def stop(*_):
        raise TimeoutError

    if not hasattr(signal, "setitimer"):  # as on Windows
        yield
        return
    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS / 5)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def _changed_expression(name, check, wrong):
    """The sentence of the variant of the solution that gives the wrong results, or None."""
    end, found, least = time.process_time() + SECONDS, None, EQUAL
    variants = importlib.import_module("variants")
    for words, function in variants.of(HERE / "solutions", name):
        if time.process_time() > end:
            break
        with _limited():
            ratio = _ratio(check, function, *wrong[0])
        if ratio >= least:
            continue
        ratio = np.median([ratio, *(_ratio(check, function, *one) for one in wrong[1:])])
        if ratio < least:
            found, least = words, ratio
        if least < 1e-9:
            break
    return found


def grade(name, function, path=None):
    """Return whether a function solves the exercise, and the lines that say how well."""
    check = importlib.import_module(f"checks.{name}")
    check.solve = solution(name)
    cases = [check.data(np.random.default_rng(seed)) for seed in range(getattr(check, "CASES", 5))]
    unit, outputs, seen, start = check.UNIT, [], [], time.process_time()
    try:
        for case in cases:
            outputs.append(checked(name, _called(name, function, case.inputs, path), check.RETURNS))
            seen = seen or getattr(check, "seen", lambda *_: [])(outputs[-1], case)
    except Refused as refused:
        return False, [str(refused)]
    slow = time.process_time() - start > SECONDS / 20
    right = [checked(name, check.solve(*copy.deepcopy(case.inputs)), check.RETURNS) for case in cases]
    reference = _rms([check.error(one, case) for one, case in zip(right, cases, strict=True)])
    allowed = max(getattr(check, "LIMIT", 1.25) * reference, getattr(check, "FLOOR", 1e-6))

    def judged(outputs):
        """Error of results, and the first faults."""
        with np.errstate(all="ignore"):
            of = getattr(check, "faults", lambda *_: [])
            error = _rms([check.error(one, case) for one, case in zip(outputs, cases, strict=True)])
            return error, next(filter(None, map(of, outputs, cases)), [])

    def passes(make):
        try:
            error, faults = judged([checked(name, one, check.RETURNS) for one in make()])
        except Exception:  # what is tried may break in any way
            return False
        return error <= allowed and not faults

    def cause():
        def call(function, inputs):
            return checked(name, _called(name, function, inputs, path), check.RETURNS)

        finder = importlib.import_module("causes")
        return finder.of(check, function, call, outputs, right, cases, passes, slow=slow)

    error, faults = judged(outputs)
    beside = [f"solution {reference:.3g}"]
    if hasattr(check, "ours"):
        ours = _rms([check.error(check.ours(case), case) for case in cases])
        beside.append(f"thesisrecon {ours:.3g}")
    if hasattr(check, "bound"):
        beside.append(f"bound {_rms([check.bound(case) for case in cases]):.3g}")
    lines = [f"error {error:.3g} {unit}, RMS over {len(cases)} data sets ({', '.join(beside)})"]
    if error <= allowed and not faults and not seen:
        return True, lines
    if seen or error <= allowed:
        return False, [*lines, *(f"reason: {fault}" for fault in seen or faults)]
    known = slow and faults
    if (sentence := _mistake(name, check, outputs, right, cases, cause=cause, known=known)) is not None:
        return False, [*lines, f"reason: {sentence}"]
    unknown = f"no usual mistake explains the error; it must be at most {allowed:.3g}"
    return False, [*lines, *(f"reason: {fault}" for fault in faults or [unknown])]


def main(name, path):
    """Grade a file and print the lines; the exit code is 0 if it passes, else 4."""
    try:
        passed, lines = grade(name, read(path, name), path)
    except Refused as refused:
        passed, lines = False, [str(refused)]
    print("\n".join([f"{name}: {'passed' if passed else 'not solved'}", *lines]))
    return 0 if passed else 4


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
