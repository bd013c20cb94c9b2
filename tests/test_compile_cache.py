"""Compiled programs are kept where only their user can write, and come out again."""

import os
import stat

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

from ne_dreamer_jax.system import compile_cache


@pytest.fixture(autouse=True)
def _home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for name in ("JAX_COMPILATION_CACHE_DIR", compile_cache.SWITCH):
        monkeypatch.delenv(name, raising=False)
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def test_the_folder_is_the_users_alone(tmp_path):
    folder = compile_cache.enable()
    assert folder == jax.config.jax_compilation_cache_dir
    assert folder.startswith(str(tmp_path / "ne_dreamer_jax") + os.sep)
    for path in (folder, tmp_path / "ne_dreamer_jax"):
        assert stat.S_IMODE(os.stat(path).st_mode) == 0o700
    assert compile_cache.enable() == folder


def test_a_folder_that_others_may_write_to_is_not_used(tmp_path):
    (tmp_path / "ne_dreamer_jax").mkdir()
    (tmp_path / "ne_dreamer_jax").chmod(0o777)
    assert compile_cache.enable().startswith("off: ")
    assert jax.config.jax_compilation_cache_dir is None


def test_a_folder_that_cannot_be_made_does_not_stop_anyone(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert compile_cache.enable().startswith("off: ")


def test_it_can_be_switched_off_or_put_elsewhere(tmp_path, monkeypatch):
    monkeypatch.setenv(compile_cache.SWITCH, "off")
    assert compile_cache.enable() == "off (NE_DREAMER_JAX_CACHE=off)"
    monkeypatch.delenv(compile_cache.SWITCH)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/elsewhere")
    assert compile_cache.enable().startswith("/elsewhere")
    assert not list(tmp_path.iterdir())


def test_a_program_is_compiled_once():
    compile_cache.enable()
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    compilation_cache.reset_cache()

    def compiled():
        with compile_cache.hits() as hits:
            jax.jit(lambda x: jnp.sin(x) + 1.0).lower(jnp.ones(3)).compile()
        return len(hits)

    assert [compiled(), compiled()] == [0, 1]
