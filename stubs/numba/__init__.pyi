# What sfmapp uses of numba, which has no types of its own: a kernel is called as the function that it is made of.
from collections.abc import Callable
from typing import Any, Literal, TypeVar

import numpy as np

_Kernel = TypeVar("_Kernel", bound=Callable[..., Any])

__version__: str
types: Any

def float32(value: float | np.integer[Any]) -> float: ...
def njit(
    *,
    cache: bool,
    nogil: bool,
    error_model: Literal["python", "numpy"] = "python",
    inline: Literal["never", "always"] = "never",
) -> Callable[[_Kernel], _Kernel]: ...
def carray(pointer: Any, shape: tuple[int, ...]) -> Any: ...
def cfunc(signature: Any, *, cache: bool) -> Callable[[Callable[..., None]], Any]: ...
