"""Have numba compile kernels with less bookkeeping, to the same machine code.

Most of what numba takes to compile a kernel is Python, and much of that is asked for again and again or is thrown away
unread. What is here does the same with less: it reads options from a dictionary and not through a property each, tells
nobody of a lock that nobody listens to, does not mark in colour why a template did not fit, lists variables by the type
of what holds them, and keeps what an operator gives for numbers and arrays. Besides, a wrapper that C could call is
made only for what is a callback of C. numba 0.68 is what this was written for; another is left as it is.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import Any

NUMBA_VERSION = "0.68."
_LOCK_EVENT = "numba:llvm_lock"
_PATCHING = threading.Lock()


def compile_sparingly() -> bool:
    """Have numba compile so in this process from now on; a second call changes nothing.

    The process has to be a command's own, as in :func:`sfmapp.kernel_cache.load_numba_sparingly`: in others, a listener
    to LLVM's lock would no longer be called, nor could what is compiled be an argument of a kernel.

    Returns:
        Whether it does so; not if numba is another one.
    """
    import numba

    if not numba.__version__.startswith(NUMBA_VERSION):
        return False
    from numba.core import errors, event, ir
    from numba.core.cpu import CPUContext
    from numba.core.targetconfig import TargetConfig
    from numba.core.types.functions import BaseFunction

    with _PATCHING:
        if not hasattr(TargetConfig.values, "__wrapped__"):
            TargetConfig.values = _values_at_once(TargetConfig.values)
            event.start_event = _but_for_the_lock(event.start_event)
            event.end_event = _but_for_the_lock(event.end_event)
            errors._termcolor_inst = _plain(errors)
            ir.Inst._rec_list_vars = _variables_by_type(ir, ir.Inst._rec_list_vars)
            BaseFunction.get_call_type = _remembered(BaseFunction.get_call_type)
            CPUContext.create_cfunc_wrapper = _if_asked_for(CPUContext.create_cfunc_wrapper)
    return True


def _values_at_once(values: Callable[[Any], dict[str, Any]]) -> Callable[[Any], dict[str, Any]]:
    """``TargetConfig.values``: all options, those that are set and the defaults of the others."""
    defaults: dict[type, dict[str, Any]] = {}

    @wraps(values)
    def method(options: Any) -> dict[str, Any]:
        kind = type(options)
        if kind not in defaults:
            defaults[kind] = {name: option.default for name, option in kind.options.items()}
        return {**defaults[kind], **options._values}

    return method


def _but_for_the_lock(tell: Callable[..., None]) -> Callable[..., None]:
    """``start_event`` and ``end_event`` of numba; LLVM's lock is taken thousands of times for each kernel."""

    @wraps(tell)
    def function(kind: str, *args: Any, **named: Any) -> None:
        if kind != _LOCK_EVENT:
            tell(kind, *args, **named)

    return function


def _plain(errors: Any) -> Any:
    """A scheme of numba's without colours."""

    class Plain(errors._DummyColorScheme):  # type: ignore[misc]
        def code(self, msg: str) -> str:
            return msg

        errmsg = filename = indicate = highlight = reset = code

    return Plain()


def _variables_by_type(ir: Any, list_variables: Callable[..., list[Any]]) -> Callable[..., list[Any]]:
    """``Inst._rec_list_vars``, the variables in a value of the intermediate representation, in its order."""
    kinds = (ir.Var, ir.Inst, (list, tuple), dict)  # the first that fits
    kind_of: dict[type, int] = {}

    def gather(value: Any, found: list[Any]) -> None:
        kind = kind_of.get(of := type(value))
        if kind is None:
            kind = kind_of[of] = next((n for n, each in enumerate(kinds) if issubclass(of, each)), len(kinds))
        if kind == 0:
            found.append(value)
        elif kind == 1:
            found.extend(value.list_vars())
        elif kind == 2:
            for each in value:
                gather(each, found)
        elif kind == 3:
            for each in value.values():
                gather(each, found)

    @wraps(list_variables)
    def method(instruction: Any, value: Any) -> list[Any]:
        found: list[Any] = []
        gather(value, found)
        return found

    return method


def _remembered(resolve: Callable[..., Any]) -> Callable[..., Any]:
    """``BaseFunction.get_call_type``, the signature that a function has for types, found once.

    Only for what numba brings as such, with numbers and arrays of them: what it implements in Python itself, by
    overloads and intrinsics, it compiles in different ways under different options.
    """
    from numba.core import types

    plain = (types.Number, types.Boolean, types.IntegerLiteral, types.BooleanLiteral)

    def is_plain(each: Any) -> bool:
        return isinstance(each, plain) or (isinstance(each, types.Array) and isinstance(each.dtype, plain))

    @wraps(resolve)
    def method(function: Any, context: Any, args: Any, kws: Any) -> Any:
        if kws:
            return resolve(function, context, args, kws)
        known = function.__dict__.setdefault("_known", {})
        key = context, tuple(args)
        if (signature := known.get(key)) is not None:
            function._impl_keys[signature.args] = function.typing_key
            return signature.replace()
        signature = resolve(function, context, args, kws)
        if function._impl_keys.get(signature.args) is function.typing_key and all(map(is_plain, args)):
            known[key] = signature.replace()
        return signature

    return method


def _if_asked_for(make: Callable[..., None]) -> Callable[..., None]:
    """``create_cfunc_wrapper`` for what is compiled as a callback for C, where numba sets the option itself."""
    from numba.core.targetconfig import ConfigStack

    @wraps(make)
    def method(*args: Any, **named: Any) -> None:
        if (flags := ConfigStack.top_or_none()) is None or flags.is_set("no_cfunc_wrapper"):
            make(*args, **named)

    return method
