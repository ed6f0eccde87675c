"""JAX's modes that programs here do not expect: of no effect on commands."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import pytest

from sqn_jax.env import make_env
from sqn_jax.env.arithmetic import to_integer
from sqn_jax.training import devices

MODES = {
    "jax_enable_x64": (False, True),
    "jax_numpy_dtype_promotion": ("standard", "strict"),
    "jax_debug_nans": (False, True),
    "jax_debug_infs": (False, True),
    "jax_disable_jit": (False, True),
}


@pytest.fixture(autouse=True)
def modes_as_before() -> Iterator[None]:
    yield
    for name, (usual, _) in MODES.items():
        jax.config.update(name, usual)


@pytest.mark.parametrize("name", MODES)
def test_a_command_has_its_own_modes_and_says_so(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    usual, other = MODES[name]
    jax.config.update(name, other)
    devices.require("cpu")
    assert getattr(jax.config, name) == usual
    assert capsys.readouterr().err == f"{name.upper()} is {other}, used is {usual}\n"
    devices.require("cpu")
    assert capsys.readouterr().err == ""


def test_double_precision_is_refused_in_one_line() -> None:
    with jax.enable_x64(True):
        for compute in (lambda: make_env("maze"), lambda: to_integer(jnp.zeros(3))):
            with pytest.raises(ValueError, match=r"\Ajax_enable_x64 is on, expected it off: .*\Z"):
                compute()
    assert to_integer(jnp.zeros(1)).dtype == jnp.int32


def test_a_kind_of_device_that_jax_fails_to_find_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail() -> None:
        raise AssertionError

    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    monkeypatch.setattr(jax, "devices", fail)
    with pytest.raises(ValueError, match=r"finds no device .*\(JAX_PLATFORMS is 'cuda'\)\Z"):
        devices.require(None)
