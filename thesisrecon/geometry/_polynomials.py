"""Real roots of polynomials in compiled code, by the roots of their derivatives (Yuksel, HPG 2022)."""

from thesisrecon._numba import empty, kernel
from thesisrecon.arrays import F64


@kernel
def horner(c: F64, x: float) -> tuple[float, float]:
    """Return value and derivative of the polynomial c, lowest power first."""
    value, slope = c[len(c) - 1], 0.0
    for k in range(len(c) - 2, -1, -1):
        slope = slope * x + value
        value = value * x + c[k]
    return value, slope


@kernel
def _root_between(c: F64, low: float, high: float, rising: bool) -> float:
    """Return the root of c in [low, high] by Newton's method, or bisection outside the bracket."""
    x = 0.5 * (low + high)
    for _ in range(100):
        value, slope = horner(c, x)
        if value == 0.0:
            break
        if (value > 0.0) == rising:
            high = x
        else:
            low = x
        moved = x - value / slope
        if not low < moved < high:
            moved = 0.5 * (low + high)
        # The bracket has no number between its ends.
        if abs(moved - x) <= 1e-16 + 2e-16 * abs(x):
            break
        x = moved
    return x


@kernel
def roots_in_unit_interval(c: F64, roots: F64) -> int:
    """Fill roots (D + 1,) with those of c (D + 1,) in [-1, 1] by those of its derivatives; their number."""
    degree = len(c) - 1
    derivative, cuts = empty(degree + 1), empty(degree + 2)
    found = 0
    for order in range(degree - 1, -1, -1):
        d = derivative[: degree - order + 1]
        for k in range(order, degree + 1):
            factor = 1.0
            for m in range(k - order + 1, k + 1):
                factor *= m
            d[k - order] = factor * c[k]
        cuts[0] = -1.0
        for k in range(found):
            cuts[k + 1] = roots[k]
        cuts[found + 1] = 1.0
        pieces, found = found + 1, 0
        left, _ = horner(d, -1.0)
        for k in range(pieces):
            right, _ = horner(d, cuts[k + 1])
            if (left < 0.0 < right) or (right < 0.0 < left):
                roots[found] = _root_between(d, cuts[k], cuts[k + 1], left < 0.0)
                found += 1
            elif right == 0.0 and k + 1 < pieces:
                roots[found] = cuts[k + 1]
                found += 1
            left = right
    return found
