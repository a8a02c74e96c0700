"""Kernels that are compiled with less bookkeeping: the same machine code, the same errors."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import numba
import pytest
from numba.core.targetconfig import TargetConfig

from sfmapp.kernel_compiling import compile_sparingly

# numbers, arrays, tuples, a closure that is inlined, numpy's functions, an overload under two models of errors, a
# callback of C
PROGRAM = r"""
import json, math, re, sys
if sys.argv[1] == "sparingly":
    from sfmapp.kernel_compiling import compile_sparingly
    assert compile_sparingly() and compile_sparingly()
import numba, numpy as np
from llvmlite import binding
from numba import njit

@njit(inline="always")
def clip(value, low, high):
    return min(max(value, low), high)

@njit(error_model="numpy")
def ratios(values, weights):
    out = np.empty(len(values))
    for n in range(len(values)):
        out[n] = clip(values[n] / weights[n], -1.0, 1.0) // 0.5 + math.sqrt(n) % 3
    return out

@njit
def work(values, indices):
    a, b = values[1:], values[:-1]
    found = ratios(a, b)
    if indices[0] > 2 and not indices[-1] == 3:
        found[indices[0] - 2] += np.sum(a * b) / (indices[1] // 2)
    return found, (len(values), values.shape[0] << 1, -abs(indices[0]) ** 2)

@njit
def wrong(values):
    return values.nothing + "text"

@numba.cfunc("f8(f8)")
def half(value):
    return value / 2.0

values, indices = np.array([1.0, 2.0, 4.0, -3.0]), np.array([3, 4])
result = [np.asarray(each).tolist() for each in work(values, indices)] + [half.ctypes(5.0)]
code, wrappers = {}, 0
for kernel in (ratios, work):
    (text,) = kernel.inspect_llvm().values()
    for function in binding.parse_assembly(text).functions:
        if "cfunc" in function.name:
            wrappers += 1
        elif not function.is_declaration:
            # numbers of attributes, of metadata and of equal constants count what is beside
            code[function.name] = re.sub(r"[#!]\d+|(?<=[0-9a-f]{40})\.\d+", "", str(function))
try:
    wrong(values)
except numba.TypingError as error:
    message = re.sub("\x1b\\[[0-9;]*m", "", str(error))
print(json.dumps({"result": result, "code": code, "message": message, "wrappers": wrappers}))
"""


def run(how: str) -> dict[str, Any]:
    done = subprocess.run([sys.executable, "-c", PROGRAM, how], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_code_results_and_errors_are_those_of_numba_whole() -> None:
    whole, sparing = run("whole"), run("sparingly")
    assert whole.pop("wrappers") == 2
    assert sparing.pop("wrappers") == 0
    assert sum("work" in name for name in whole["code"]) >= 2  # the kernel, and what Python calls
    assert sparing == whole


def test_another_numba_is_left_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    values = TargetConfig.values
    monkeypatch.setattr(numba, "__version__", "0.69.0")
    assert not compile_sparingly()
    assert TargetConfig.values is values
