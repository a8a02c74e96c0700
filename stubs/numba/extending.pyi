from collections.abc import Callable
from typing import Any

models: Any
register_model: Any

# in kernels without the typing context, which comes first
def intrinsic(function: Callable[..., Any]) -> Callable[..., Any]: ...
