"""Causes of a wrong result that no table lists: what repairs it, and what it does not depend on."""

import copy
import inspect
import itertools

import numpy as np


def _square(a):
    return a.ndim > 1 and a.shape[-1] == a.shape[-2]


def _pixels(a):
    return a.ndim > 1 and a.shape[-1] == 2


def _spatial(a):
    return a.ndim == 2 and a.shape[1] == 3


def _always(a):
    return a.dtype.kind in "fiu"


# What is wrong, the arrays that can have it, and what makes them right.
CHANGES = [
    ("{} is transposed", _square, lambda a: np.swapaxes(a, -1, -2)),
    ("the sign of {} is wrong", _always, lambda a: -a),
    ("x and y of {} are swapped", _pixels, lambda a: a[..., ::-1]),
    ("{} is inverted", _square, np.linalg.inv),
    ("{} is transposed and inverted", _square, lambda a: np.linalg.inv(np.swapaxes(a, -1, -2))),
]
OF_RESULTS = [
    ("{} is inverted (1 / x)", _always, lambda a: 1 / a),
    ("{} is squared: the root is missing", _always, lambda a: np.sqrt(np.abs(a))),
    ("the root of {} is taken", _always, np.square),
    ("{} is in degrees, not in radians", _always, np.radians),
    ("{} is in radians, not in degrees", _always, np.degrees),
    ("True and False are exchanged", lambda a: a.dtype.kind == "b", np.logical_not),
    ("the rows of {} are in reverse order", lambda a: a.ndim > 1, lambda a: a[::-1]),
    *(
        (
            f"the columns of {{}} are not in order: take them as {order}",
            _spatial,
            lambda a, order=order: a[:, order],
        )
        for order in map(list, itertools.permutations(range(3)))
    ),
]


def of(check, function, call, outputs, right, cases, passes, *, slow):
    """A sentence on a wrong function, or None.

    ``call`` calls it with copies, ``passes`` tells whether the results that a function makes are accurate
    enough. A slow function is not called again.
    """
    for find in (_of_results, _copied) if slow else (_of_results, _copied, _of_arguments, _unused):
        with np.errstate(all="ignore"):
            sentence = find(check, function, call, outputs, right, cases, passes)
        if sentence is not None:
            return sentence
    return None


def _arrays(output):
    return list(output) if isinstance(output, tuple) else [output]


def _with(output, k, array):
    """A result with another array at place k."""
    if not isinstance(output, tuple):
        return array
    return (*output[:k], array, *output[k + 1 :])


def _of_results(check, function, call, outputs, right, cases, passes):
    """What makes the results right."""
    for k, (label, _) in enumerate(check.RETURNS):
        mine, ours = ([np.asarray(_arrays(one)[k]) for one in every] for every in (outputs, right))
        for words, fits, repair in CHANGES + OF_RESULTS:
            if all(map(fits, mine)) and passes(lambda k=k, mine=mine, repair=repair: [
                _with(one, k, repair(a)) for one, a in zip(outputs, mine, strict=True)
            ]):  # fmt: skip
                return words.format(label)
        if any(a.shape != b.shape or a.dtype.kind == "b" for a, b in zip(mine, ours, strict=True)):
            continue
        for words, fitted in (("a factor, of {:.4g}", _factor), ("a constant, of {:.4g}", _constant),
                              ("a factor of each row: by what is it divided?", _row_factors)):  # fmt: skip
            found = [fitted(a, b) for a, b in zip(mine, ours, strict=True)]
            if passes(lambda k=k, found=found: [
                _with(one, k, changed) for one, (changed, _) in zip(outputs, found, strict=True)
            ]):  # fmt: skip
                return f"{label} is right up to {words.format(found[0][1])}"
    return None


def _factor(a, b):
    scale = np.sum(a * b) / max(np.sum(b * b), 1e-300)
    return a / (scale or np.nan), scale


def _constant(a, b):
    more = np.median(a - b)
    return (a - more if a.size > 3 else a), more


def _row_factors(a, b):
    if a.ndim != 2 or a.shape[1] < 2:
        return a, 1.0
    scale = np.sum(a * b, axis=1, keepdims=True) / np.sum(a * a, axis=1, keepdims=True)
    return a * scale, 1.0


def _names(check):
    return list(inspect.signature(check.solve).parameters)


def _copied(check, function, call, outputs, right, cases, passes):
    """A result that is an argument as it was given."""
    for k, (label, _) in enumerate(check.RETURNS):
        for place, name in enumerate(_names(check)):
            pairs = [(_arrays(o)[k], case.inputs[place], _arrays(r)[k])
                     for o, case, r in zip(outputs, cases, right, strict=True)]  # fmt: skip
            if all(
                isinstance(given, np.ndarray)
                and np.array_equal(own, given)
                and not np.array_equal(ours, given)
                for own, given, ours in pairs
            ):
                return f"{label} is returned as {name} was given"
    return None


def _of_arguments(check, function, call, outputs, right, cases, passes):
    """A change of the arguments with which the function is right."""
    names = _names(check)
    given = cases[0].inputs
    tried = [
        (f"{names[i]} and {names[j]} are swapped", lambda args, i=i, j=j: _swapped(args, i, j))
        for i in range(len(given)) for j in range(i)
        if np.shape(given[i]) == np.shape(given[j]) and isinstance(given[i], np.ndarray)
    ]  # fmt: skip
    tried += [
        (words.format(name), lambda args, k=k, change=change: [*args[:k], change(args[k]), *args[k + 1 :]])
        for k, name in enumerate(names) for words, fits, change in CHANGES
        if isinstance(given[k], np.ndarray) and fits(given[k])
    ]  # fmt: skip
    for words, change in tried:
        if passes(lambda change=change: [call(function, change(list(case.inputs))) for case in cases]):
            return words
    return None


def _swapped(args, i, j):
    args = list(args)
    args[i], args[j] = args[j], args[i]
    return args


def _unused(check, function, call, outputs, right, cases, passes):
    """An argument, or all but its first rows, on which the solution depends and the function does not."""
    rng = np.random.default_rng(0)
    if all(np.ptp(array) == 0 for array in _arrays(outputs[0])):
        return None
    for k, name in enumerate(_names(check)):
        value = cases[0].inputs[k]
        if isinstance(value, float):
            tried = [(f"{name} is not used", value * 1.3)]
        elif isinstance(value, np.ndarray) and value.dtype.kind == "f":
            noise = rng.normal(0, 0.1, value.shape) * (np.std(value) or 1.0)
            tried = [(f"{name} is not used", value + noise)]
            tried += [
                (f"only the first {n} of {name} are used", np.concatenate([value[:n], (value + noise)[n:]]))
                for n in range(1, 10) if len(value) > 9
            ]  # fmt: skip
        else:
            continue
        for words, other in tried:
            args = [*cases[0].inputs[:k], other, *cases[0].inputs[k + 1 :]]
            try:
                own, ours = call(function, args), check.solve(*copy.deepcopy(args))
            except Exception:  # it may need what is changed
                continue
            if _same(own, outputs[0]) and not _same(ours, right[0]):
                return words
    return None


def _same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(_arrays(a), _arrays(b), strict=True))
