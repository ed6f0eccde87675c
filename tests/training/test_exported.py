"""Programs that an earlier command has traced: the same numbers, and never those of another."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export
from numpy.typing import NDArray

from sqn_jax import config as configs
from sqn_jax.config.presets import PRESETS
from sqn_jax.env import make_env
from sqn_jax.training import exported, loop
from sqn_jax.training.exported import ExportedJit, exported_jit, exports_in

Arrays = dict[str, NDArray[Any]]


class Cache:
    """What a folder of programs does, in memory."""

    def __init__(self) -> None:
        self.files: dict[tuple[Any, ...], Arrays] = {}

    def __call__(self, kind: str, depends_on: Iterable[bytes], make: Callable[[], Arrays]) -> Any:
        key = (kind, *depends_on)
        if key not in self.files:
            self.files[key] = make()
        return self.files[key]


class Pair(NamedTuple):
    """Something that a program takes and returns."""

    first: Any
    second: Any


def power(x: Any, exponent: int) -> Any:
    return {"power": x**exponent, "sum": x.sum()}


def twin(function: Callable[..., Any] = power, name: str = "exponent", donate: str = "") -> Any:
    """The program as another process has it: with nothing traced."""
    return ExportedJit(function, static_argname=name, donate_argname=donate)


def test_a_second_process_traces_nothing_and_has_the_same_numbers() -> None:
    cache, traced = Cache(), []

    def noted(x: Any, exponent: int) -> Any:
        traced.append(exponent)
        return power(x, exponent)

    x = jnp.linspace(-1.0, 2.0, 7)
    with exports_in(cache):
        first, second = (twin(noted)(x, exponent=3) for _ in range(2))
    assert traced == [3]
    assert len(cache.files) == 1
    expected = jax.jit(power, static_argnames="exponent")(x, 3)
    for results in (first, second):
        jax.tree.map(np.testing.assert_array_equal, results, expected)


def test_every_difference_that_a_program_depends_on_has_a_program_of_its_own() -> None:
    cache = Cache()
    with exports_in(cache):
        calls: list[Callable[[], Any]] = [
            lambda: twin()(jnp.ones(3), 2),
            lambda: twin()(jnp.ones(3), 3),  # the static argument
            lambda: twin()(jnp.ones(4), 2),  # the shape
            lambda: twin()(jnp.ones(3, jnp.int32), 2),  # the type
            lambda: twin()({"x": jnp.ones(3)}["x"][0], 2),
            lambda: twin(lambda x, exponent: {"other": x})(jnp.ones(3), 2),  # the function
            lambda: twin(lambda x, n: x["a"] ** n, "n")({"a": jnp.ones(3)}, 2),
            lambda: twin(lambda x, n: x["a"] ** n, "n")({"a": jnp.ones(3), "b": 1.0}, 2),
        ]
        for number, call in enumerate(calls, start=1):
            call()
            assert len(cache.files) == number, number
        with jax.default_matmul_precision("float32"):
            calls[0]()
        assert len(cache.files) == len(calls) + 1, "a setting of JAX is not considered"
        for call in calls:
            call()
        assert len(cache.files) == len(calls) + 1


def test_weak_types_keep_their_meaning() -> None:
    """1.5 times a float16 is float16 or float32, depending on whose number 1.5 is."""
    cache, number = Cache(), exported_jit(lambda x, y: x * y)
    small = jnp.ones(2, jnp.float16)
    with exports_in(cache):
        assert number(small, 1.5).dtype == jnp.float16
        assert number(small, np.float32(1.5)).dtype == jnp.float32


def test_what_is_donated_is_gone() -> None:
    add = twin(lambda x, y: (x + y, y), "", donate="x")
    x, y = jnp.ones(1000), jnp.ones(1000)
    with exports_in(Cache()):
        add(x, y)
    assert x.is_deleted()
    assert not y.is_deleted()


def test_without_a_cache_or_under_a_trace_it_is_jit() -> None:
    cache, double = Cache(), exported_jit(lambda x: 2 * x)
    assert double(3.0) == 6
    with exports_in(cache):
        np.testing.assert_array_equal(jax.vmap(double)(jnp.arange(3.0)), [0, 2, 4])
        assert jax.grad(double)(1.0) == 2
        with jax.disable_jit():
            assert double(4.0) == 8
    assert not cache.files


def test_what_cannot_be_exported_is_traced_and_a_line_says_why(
    capsys: pytest.CaptureFixture[str],
) -> None:
    cache, env_params = Cache(), make_env("maze")
    with exports_in(cache):
        pair = exported_jit(lambda x: Pair(x, 2 * x))(1.0)  # A class from outside is not imported.
        same = exported_jit(lambda x: x)(env_params)
    assert not cache.files
    assert (pair.first, pair.second) == (1, 2)
    assert same.config == env_params.config
    for line, word in zip(capsys.readouterr().err.splitlines(), ("Pair", "static"), strict=True):
        assert "traced anew" in line
        assert word in line


@pytest.mark.parametrize("damage", ["no module", "no names", "nobody's class", "short", "zeros"])
def test_a_file_that_holds_something_else_is_a_line(
    damage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    cache = Cache()
    with exports_in(cache):
        expected = twin()(jnp.ones(3), 2)
        (arrays,) = cache.files.values()
        if damage == "no module":
            del arrays["module"]
        elif damage == "short":
            arrays["module"] = arrays["module"][:30]
        elif damage == "zeros":
            arrays["module"] = np.zeros(1000, np.uint8)
        else:
            names = b"junk" if damage == "no names" else b'["sqn_jax.nowhere:Class"]'
            arrays["nodes"] = np.frombuffer(names, np.uint8)
        found = twin()(jnp.ones(3), 2)
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert "traced anew" in capsys.readouterr().err


def test_settings_of_the_world_are_part_of_the_key() -> None:
    """They are static fields of an argument: two worlds of equal shapes that differ in these."""
    cache = Cache()
    far, near = (
        make_env("maze", configs.EnvConfig(reward_navigation=2.0, bumper=bumper))
        for bumper in (0.0, 0.1)
    )
    with exports_in(cache):
        for env_params in (far, near, far):
            twin(lambda params: params.commands.sum(), "")(env_params)
    assert len(cache.files) == 2


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_training_by_every_preset_can_be_exported(preset: str) -> None:
    """With all that a run has: replay, optimizer, curriculum, several maps."""
    config = PRESETS[preset]
    env_params = make_env("maze", config.env)
    program = loop.make_program(env_params, config)
    runner = loop.runner_shapes(program)
    world = jax.eval_shape(lambda x: x, env_params)
    flat, tree = jax.tree.flatten((runner, world))

    def chunk(*leaves: Any) -> Any:
        return loop.train_chunk(*jax.tree.unflatten(tree, leaves), program)

    arrays = exported._packed(export.export(jax.jit(chunk))(*flat))
    shapes = exported._unpacked(arrays)
    metrics = jax.eval_shape(chunk, *flat)
    assert shapes.out_tree == jax.tree.structure(metrics)
    assert [x.shape for x in shapes.out_avals] == [x.shape for x in jax.tree.leaves(metrics)]


def test_a_run_from_a_cache_is_the_run_without_one_to_the_bit() -> None:
    config = configs.from_dict(configs.to_dict(PRESETS["smoke"]) | {"total_episodes": 32})
    env_params = make_env("maze", config.env)
    program, cache = loop.make_program(env_params, config), Cache()

    def trained() -> Any:
        ends = [
            runner.learner for runner, _ in loop.run(loop.start_run(program), env_params, program)
        ]
        return jax.tree.map(np.asarray, ends[-1])

    expected = trained()
    with exports_in(cache):
        for _ in range(2):
            loop._start_run._programs.clear()
            loop._compiled_train_chunk._programs.clear()
            jax.tree.map(np.testing.assert_array_equal, trained(), expected)
    assert len(cache.files) == 2, "the start and a chunk"
