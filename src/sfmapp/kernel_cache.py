"""Where numba may keep compiled kernels when the two places that it knows by itself will not do.

numba writes beside the source, else below the home of the user. In a container, on a cluster or in a CI job the first
is often read-only and the second not there, and then no module with a kernel can be loaded. Here a folder of this user
alone below the system's temporary folder steps in. What numba caches is code that it unpickles and runs, so a folder
counts only if nobody but this user and root can change it or put another in its place.
"""

from __future__ import annotations

import os
import stat
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from pathlib import Path
from typing import Any

from sfmapp.kernel_compiling import compile_sparingly

VARIABLE = "NUMBA_CACHE_DIR"
NAME = "sfmapp-kernels"
ADVICE = f"set {VARIABLE} to a folder that you, and nobody else, can write to; one in OUT will do"
_PACKAGE = Path(__file__).resolve().parent
_PATCHING = threading.Lock()


def provide_kernel_cache() -> None:
    """Point numba at a place of ours if it has none that is safe; called before any kernel is loaded.

    Where there is none at all nothing is done: numba raises when the first kernel is loaded, which is known by
    :func:`is_without_cache`.
    """
    if not hasattr(os, "geteuid") or _numba_finds_one():
        return
    for folder in _temporary_folders():
        if (private := _private_folder(folder)) is not None:
            os.environ[VARIABLE] = str(private)  # for the processes that we start as well
            if "numba" in sys.modules:
                sys.modules["numba"].config.CACHE_DIR = str(private)
            return


def is_without_cache(error: Exception) -> bool:
    """Whether an exception is numba's way to say that it found no place."""
    return isinstance(error, RuntimeError) and str(error).startswith("cannot cache function")


def take_turns(*, strict: bool = False) -> None:
    """Have this process from now on read numba's cache, and add to it, while no other that does so is writing.

    numba reads the index of a kernel, writes it with an entry more, and then the code. Two processes that do so at once
    may give the same name to code for different arguments, and a third may read the code that had this name before.

    Args:
        strict: fail to read or write where the file system knows no locks, instead of doing without.
    """
    from fcntl import LOCK_EX, LOCK_SH

    from numba.core.caching import IndexDataCacheFile as Files

    with _PATCHING:
        if not hasattr(Files.save, "__wrapped__"):  # a second lock would wait for the first
            Files.load = _in_turn(Files.load, LOCK_SH, strict)
            Files.save = _in_turn(Files.save, LOCK_EX, strict)


def load_numba_sparingly() -> None:
    """Have numba load kernels from its cache in this process without what it compiles others with.

    Before it loads the first one numba loads all that any kernel might be compiled with, and scipy.linalg for those
    that call BLAS: together as much time and memory as numba itself. What is compiled already needs none of it. Here
    numba does so before it first compiles, and always without BLAS, which no kernel of ours calls. Of each kernel it
    also reads the code from which others could inline it, and lists what that defines, half of the time of loading;
    here only of those that others are compiled with. What is missing is compiled with less, too, see
    :mod:`sfmapp.kernel_compiling`. The process has to be a command's own; a program that imports sfmapp keeps its numba
    whole.
    """
    from numba.core import environment
    from numba.core.caching import FunctionCache
    from numba.core.codegen import JITCodeLibrary
    from numba.core.cpu import CPUContext

    compile_sparingly()
    with _PATCHING:
        if "load_overload" not in vars(FunctionCache):
            FunctionCache.load_overload = _load_compiled
            environment._rebuild_env = _environment_alone(environment._rebuild_env)
            CPUContext.load_additional_registries = _without_blas(CPUContext.load_additional_registries)
            JITCodeLibrary._unserialize = classmethod(_code_alone(JITCodeLibrary._unserialize.__func__))
            JITCodeLibrary.get_pointer_to_function = _pointer_into_code(JITCodeLibrary.get_pointer_to_function)
            JITCodeLibrary._get_module_for_linking = _read_when_linked(JITCodeLibrary._get_module_for_linking)


def is_ours_alone(folder: Path) -> bool:
    """Whether nobody but this user and root can change what lies in a folder, nor put another in its place.

    Every folder on the way has to be of this user or of root, and closed to others; in one with the sticky bit, such as
    /tmp, others can add something but not touch what is ours.
    """
    try:
        folder = folder.resolve(strict=True)
        ways = [(path, path.stat()) for path in (folder, *folder.parents)]
    except (OSError, RuntimeError):  # not there, not to be looked into, or a loop of links
        return False
    return ways[0][1].st_uid == os.geteuid() and all(
        found.st_uid in (0, os.geteuid())
        and (not _open_to_others(found) or (path != folder and bool(found.st_mode & stat.S_ISVTX)))
        for path, found in ways
    )


def _in_turn(work: Callable[..., Any], how: int, strict: bool) -> Callable[..., Any]:
    @wraps(work)
    def method(files: Any, *args: Any) -> Any:
        with _locked(files._cache_path, how, strict):
            return work(files, *args)

    return method


def _load_compiled(cache: Any, signature: Any, target: Any) -> Any:
    """``load_overload`` of numba's cache; what kernels call for memory has to be there, as the rest would see to."""
    from numba.core.runtime import rtsys

    rtsys.initialize(target)
    with cache._guard_against_spurious_io_errors():
        return cache._load_overload(signature, target)


def _environment_alone(rebuild: Callable[..., Any]) -> Callable[..., Any]:
    """``_rebuild_env`` of numba without the modules of numba that a kernel was compiled from: compiled code looks
    nothing up in them."""

    @wraps(rebuild)  # its name goes into the cache
    def method(module: str, constants: list[Any], name: str) -> Any:
        from numba.core.environment import Environment, lookup_environment

        if module in sys.modules or lookup_environment(name) is not None:
            return rebuild(module, constants, name)
        found = Environment({"__name__": module})
        found.consts[:] = constants
        found.env_name = name
        Environment._memo[name] = found
        return found

    return method


def _code_alone(unserialize: Callable[..., Any]) -> Callable[..., Any]:
    """``_unserialize`` of numba's libraries with the machine code alone; the bitcode beside it stays unread."""

    @wraps(unserialize)
    def method(library_class: Any, codegen: Any, state: Any) -> Any:
        name, kind, data = state
        if kind != "object":
            return unserialize(library_class, codegen, state)
        library = codegen.create_library(name)
        library.enable_object_caching()
        library._set_compiled_object(data[0])
        library._finalize_final_module()
        library._unread = data
        return library

    return method


def _pointer_into_code(find: Callable[..., Any]) -> Callable[..., Any]:
    """``get_pointer_to_function`` of numba's libraries for those whose bitcode is unread: their own entries are asked
    for, and an entry that was made has its name among the symbols of the code."""

    @wraps(find)
    def method(library: Any, name: str) -> Any:
        if (unread := getattr(library, "_unread", None)) is None:
            return find(library, name)
        return library.codegen._engine.get_function_address(name) if name.encode() in unread[0] else 0

    return method


def _read_when_linked(module_of: Callable[..., Any]) -> Callable[..., Any]:
    """``_get_module_for_linking`` of numba's libraries, which reads the bitcode if it was not yet."""

    @wraps(module_of)
    def method(library: Any) -> Any:
        if (unread := getattr(library, "_unread", None)) is not None:
            from numba.core.codegen import ll

            library._shared_module = ll.parse_bitcode(unread[1])
            library.codegen._engine._load_defined_symbols(library._shared_module)
            library._unread = None
        return module_of(library)

    return method


def _without_blas(load: Callable[[Any], None]) -> Callable[[Any], None]:
    """``load_additional_registries`` of numba's compiler for a numba that finds no BLAS."""

    @wraps(load)
    def method(context: Any) -> None:
        from numba.np import linalg

        def find_none() -> None:
            raise ImportError

        linalg.ensure_blas, found = find_none, linalg.ensure_blas
        try:
            import numba.np.arraymath  # noqa: F401
        finally:
            linalg.ensure_blas = found
        load(context)

    return method


@contextmanager
def _locked(folder: str, how: int, strict: bool) -> Iterator[None]:
    from fcntl import flock

    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:  # made by the first who saves
        yield
        return
    try:
        with suppress(*(() if strict else (OSError,))):
            flock(descriptor, how)
        yield
    finally:
        os.close(descriptor)


def _open_to_others(found: os.stat_result) -> bool:
    # many systems give each user a group of its own, and its files to that
    is_open_to_a_group = bool(found.st_mode & stat.S_IWGRP) and found.st_gid not in (0, os.getegid())
    return is_open_to_a_group or bool(found.st_mode & stat.S_IWOTH)


def _numba_finds_one() -> bool:
    """Whether numba will use a place that the user named, the source's own, or a safe one below the home."""
    named = os.environ.get(VARIABLE)
    if named and _can_write(Path(named)):
        return True  # the user's own choice, maybe one shared by a team
    if all(_can_write(room / "__pycache__") for room in _PACKAGE.iterdir() if (room / "__init__.py").is_file()):
        return True
    home = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "numba"
    if not home.is_absolute() or not _can_write(home):
        return False
    # what does not exist yet will be made by this user in the last folder that does
    return is_ours_alone(home) if home.exists() else _is_safe_to_make(home)


def _is_safe_to_make(folder: Path) -> bool:
    existing = next(path for path in folder.parents if path.exists())
    found = existing.stat()
    is_sticky = bool(found.st_mode & stat.S_ISVTX) and found.st_uid in (0, os.geteuid())
    return is_ours_alone(existing) or is_sticky


def _can_write(folder: Path) -> bool:
    """Whether files can be made in a folder, which may not exist yet."""
    try:
        existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if os.path.lexists(path))
    except (OSError, StopIteration):
        return False
    return existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)


def _temporary_folders() -> Iterator[Path]:
    # not those of tempfile: its last resort is the working folder, where nobody expects a cache
    for name in ("TMPDIR", "TEMP", "TMP"):
        if value := os.environ.get(name):
            yield Path(value).absolute()
    yield from map(Path, ("/tmp", "/var/tmp", "/dev/shm"))


def _private_folder(parent: Path) -> Path | None:
    """A folder of this user alone in ``parent``, the same one in every run; None if it cannot be had."""
    folder = parent / f"{NAME}-{os.geteuid()}"
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError:
        pass
    except OSError:
        return None
    try:
        found = folder.lstat()
    except OSError:
        return None
    is_private = stat.S_ISDIR(found.st_mode) and not found.st_mode & 0o077
    return folder if is_private and _can_write(folder) and is_ours_alone(folder) else None
