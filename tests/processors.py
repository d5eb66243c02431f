"""Other processors: variables that choose machine code of numba, OpenBLAS, NumPy and the C library (x86-64).

`python -m tests.processors` lists those that this machine can act as and this environment does not;
`python -m tests.processors NAME ARGUMENTS` runs Python as on one of them.
"""

import os
import platform
import sys

from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

SSE2, AVX2, NATIVE = "sse2", "avx2", "native"
_PRESENT = [name for name in __cpu_dispatch__ if __cpu_features__[name]]
VARIABLES = {
    "NUMBA_CPU_NAME": {SSE2: "generic", AVX2: "haswell"},
    # Without it, numba adds all features of this processor to those of the named one.
    "NUMBA_CPU_FEATURES": {SSE2: "", AVX2: ""},
    "OPENBLAS_CORETYPE": {SSE2: "Prescott", AVX2: "Haswell"},
    "NPY_DISABLE_CPU_FEATURES": {
        SSE2: " ".join(_PRESENT),
        AVX2: " ".join(name for name in _PRESENT if name == "X86_V4" or name.startswith("AVX512")),
    },
    # exp, log, sin, ... with fused multiplication and addition.
    "GLIBC_TUNABLES": {SSE2: "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F"},
}


def environment(processor: str) -> dict[str, str]:
    """Return this environment with the variables of a processor and no others of theirs."""
    kept = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    return kept | {name: values[processor] for name, values in VARIABLES.items() if processor in values}


def processors() -> list[str]:
    """Return the processors that this machine can act as."""
    if platform.machine() not in {"x86_64", "AMD64"}:
        return [NATIVE]
    return [SSE2, *([AVX2] if __cpu_features__.get("AVX2") else []), NATIVE]


if __name__ == "__main__":
    if sys.argv[1:]:
        os.execve(sys.executable, [sys.executable, *sys.argv[2:]], environment(sys.argv[1]))
    print(*(name for name in processors() if environment(name) != dict(os.environ)))
