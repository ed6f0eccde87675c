"""`jax.jit` for the large programs of a command, which take what an earlier command has traced.

JAX caches what it compiles, but traces and lowers a program in every process: seconds of Python,
more than it takes to read what was compiled. `exported_jit` has `jax.export` write the lowered
program once. Without a cache (`exports_in`), on accelerators and in runs of several processes it is
`jax.jit`.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np
from jax import export
from numpy.typing import NDArray

from sqn_jax.outside.messages import say

Arrays = Mapping[str, NDArray[Any]]
Cache = Callable[[str, Iterable[bytes], Callable[[], Arrays]], Arrays]
"""A function of a kind, of all that decides about arrays, and of what makes them; it returns them,
made now or earlier. The code of this package is for the cache to consider."""

_caches: list[Cache] = []
_registered: set[str] = set()


@contextmanager
def exports_in(cache: Cache) -> Iterator[None]:
    """Within this context `exported_jit` takes and stores programs here."""
    _caches.append(cache)
    try:
        yield
    finally:
        _caches.pop()


def exported_jit(
    function: Callable[..., Any] | None = None,
    *,
    static_argname: str = "",
    donate_argname: str = "",
) -> Any:
    """Like `jax.jit`, with at most one static and one donated argument.

    The `repr` of the static argument must say all that the program depends on, and the program
    must not depend on anything but its arguments and the settings of JAX.
    """
    make = functools.partial(
        ExportedJit, static_argname=static_argname, donate_argname=donate_argname
    )
    return make if function is None else make(function)


class ExportedJit:
    """What `exported_jit` returns."""

    def __init__(self, function: Callable[..., Any], static_argname: str, donate_argname: str):
        functools.update_wrapper(self, function)
        self._function, self._signature = function, inspect.signature(function)
        self._static, self._donated = static_argname, donate_argname
        self._jitted = jax.jit(
            function, static_argnames=static_argname or None, donate_argnames=donate_argname or None
        )
        self._programs: dict[Any, Any] = {}

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Run the program."""
        arguments = self._signature.bind(*args, **kwargs).arguments
        if not _can_export(arguments):
            return self._jitted(*args, **kwargs)
        static = arguments.pop(self._static, None)
        return self._program(arguments, static)(*arguments.values())

    def compile(self, *args: Any, **kwargs: Any) -> Any:
        """Compile for arguments of these shapes; to be called without the static argument."""
        arguments = self._signature.bind(*args, **kwargs).arguments
        if not _can_export(arguments):
            return self._jitted.lower(*args, **kwargs).compile()
        static = arguments.pop(self._static, None)
        return self._program(arguments, static).lower(*arguments.values()).compile()

    def _program(self, arguments: dict[str, Any], static: Any) -> Any:
        """The exported program under `jax.jit`, for arguments without the static one."""
        leaves, tree = jax.tree.flatten(tuple(arguments.values()))
        shapes = [_shape(leaf) for leaf in leaves]
        key = (tuple(arguments), tree, tuple(map(_description, shapes)), static, _settings())
        if key not in self._programs:
            self._programs[key] = self._exported(list(arguments), tree, shapes, static)
        return self._programs[key]

    def _exported(self, names: list[str], tree: Any, shapes: list[Any], static: Any) -> Any:
        def flat(*leaves: Any) -> Any:
            arguments = dict(zip(names, jax.tree.unflatten(tree, leaves), strict=True))
            if self._static:
                arguments[self._static] = static
            return self._function(**arguments)

        depends_on = [
            f"{self._function.__module__}.{self._function.__qualname__}",
            *(repr(names), str(tree), repr([_description(shape) for shape in shapes])),
            *(repr(static), repr(_settings())),
        ]
        try:
            arrays = _caches[-1](
                "programs",
                [text.encode() for text in depends_on],
                lambda: _packed(export.export(jax.jit(flat))(*shapes)),
            )
            run = _unpacked(arrays).call
        except Exception as error:  # A library is missing, or the file holds something else.
            reason = " ".join(str(error).split())
            say(f"{self._function.__name__} is traced anew in each process: {reason}", error=True)
            run = flat

        def call(*arguments: Any) -> Any:
            return run(*jax.tree.leaves(arguments))

        call.__name__ = self._function.__name__
        donated = names.index(self._donated) if self._donated else None
        return jax.jit(call, donate_argnums=donated)


def _can_export(arguments: Mapping[str, Any]) -> bool:
    """Only on CPUs of one process: other backends have kernels that `jax.export` does not vouch
    for."""
    return (
        bool(_caches)
        and jax.default_backend() == "cpu"
        and jax.process_count() == 1
        and not jax.config.jax_disable_jit  # type: ignore[attr-defined]
        and not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(arguments))
    )


def _shape(leaf: Any) -> jax.ShapeDtypeStruct:
    """Shape, dtype and, of arrays on several devices, how they lie there."""
    aval = jax.typeof(leaf) if not isinstance(leaf, jax.ShapeDtypeStruct) else leaf
    sharding = getattr(leaf, "sharding", None)
    if sharding is not None and sharding.num_devices == 1:
        sharding = None
    weak = getattr(aval, "weak_type", False)
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype, sharding=sharding, weak_type=weak)


def _description(shape: jax.ShapeDtypeStruct) -> str:
    return repr((shape.shape, str(shape.dtype), shape.weak_type, shape.sharding))


def _settings() -> tuple[Any, ...]:
    """What else a trace can depend on: the settings of JAX, and the devices."""
    settings = jax.config.values  # type: ignore[attr-defined]
    relevant = {k: repr(v) for k, v in settings.items() if "_cache" not in k}
    return (tuple(sorted(relevant.items())), jax.local_device_count())


def _packed(exported: export.Exported) -> dict[str, NDArray[Any]]:
    names = sorted({f"{node.__module__}:{node.__qualname__}" for node in _nodes(exported.out_tree)})
    _register(names)
    module = np.frombuffer(exported.serialize(), np.uint8)
    return {"module": module, "nodes": np.frombuffer(json.dumps(names).encode(), np.uint8)}


def _unpacked(arrays: Arrays) -> export.Exported:
    _register(json.loads(arrays["nodes"].tobytes()))
    return export.deserialize(bytearray(arrays["module"].tobytes()))


def _nodes(tree: Any) -> Iterator[type]:
    """The classes of the nodes of a tree, but those that Python has."""
    data = tree.node_data()
    if data is not None and data[0] not in (dict, list, tuple, type(None)):
        yield data[0]
    for child in tree.children():
        yield from _nodes(child)


def _register(names: Sequence[str]) -> None:
    """Tell `jax.export` how classes of this package and of Optax are called in a file."""
    for name in names:
        module, _, qualified = name.partition(":")
        if name in _registered or module.partition(".")[0] not in ("sqn_jax", "optax"):
            continue
        node = getattr(importlib.import_module(module), qualified)
        if hasattr(node, "_fields"):
            export.register_namedtuple_serialization(node, serialized_name=name)
        else:
            export.register_pytree_node_serialization(
                node,
                serialized_name=name,
                serialize_auxdata=_no_auxdata,
                deserialize_auxdata=lambda _: (),
            )
        _registered.add(name)


def _no_auxdata(auxdata: Any) -> bytes:
    if auxdata != ():
        raise ValueError(f"results with static fields cannot be exported: {auxdata}")
    return b""
