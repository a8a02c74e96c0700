"""Compiles kernels into numba's cache in a process of its own: ``python -m sfmapp.workspace.kernel_process``.

It reads the names of modules, one a line, and answers each, when its kernels are in the cache, with how many it had to
compile and the CPU seconds that it took.
"""

from __future__ import annotations

import gc
import sys
import time
from importlib import import_module

from numba.core import event as numba_event

from sfmapp.kernel_cache import load_numba_sparingly, take_turns


def main() -> None:
    """Answer until there are no more questions."""
    take_turns(strict=True)
    load_numba_sparingly()
    gc.disable()  # what compiling leaves behind is soon given back as a whole
    took = 0.0
    for line in sys.stdin:
        with numba_event.install_recorder("numba:compile") as recorder:
            import_module(line.strip()).compile_kernels()
        num_compiled = sum(event.is_end for _, event in recorder.buffer)
        took, since = time.process_time(), took
        sys.stdout.write(f"{num_compiled} {took - since}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
