"""How compiled kernels are declared: one place for numba's settings, and a list of what a run will call."""

from collections.abc import Callable
from typing import Any

from numba import f8, njit, types

from slamcli.jit.cache import KernelCache

DECLARED: list[Any] = []  # dispatchers of the kernels whose arguments are annotated, in the order of their import


def kernel(function: Callable | None = None, **options: Any) -> Any:
    """Compile a function to machine code that runs without the GIL; `options` are numba's.

    Annotate the arguments of what Python calls with numba's types, `def add(total: f8[::1], step: f8)`: such a kernel can be compiled
    before its first call, while numba alone would let the user wait for one after another. Helpers that only kernels call need none.
    Arguments that travel together are a NamedTuple, whose fields are annotated in the same way.
    """
    if function is None:
        return lambda function: kernel(function, **options)
    compiled = njit(nogil=True, **options)(function)
    compiled._cache = KernelCache(function)  # what `cache=True` does, but with a folder of our own
    if argument_types(compiled):
        DECLARED.append(compiled)
    return compiled


def argument_types(compiled: Any) -> tuple:
    """Return the numba types of a kernel's arguments, () where they are not declared."""
    code = compiled.py_func.__code__
    annotations = compiled.py_func.__annotations__
    names = code.co_varnames[: code.co_argcount]
    return tuple(_compiler_type(annotations[name]) for name in names) if any(name in annotations for name in names) else ()


def _compiler_type(annotation: Any) -> Any:
    """Return numba's type of an argument: of a NamedTuple, the type that numba finds for its values."""
    if isinstance(annotation, type) and issubclass(annotation, tuple):
        fields = [f8 if of is float else of for of in annotation.__annotations__.values()]
        return types.BaseTuple.from_types(fields, annotation)
    return annotation
