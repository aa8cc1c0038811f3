"""Programs that are kept from process to process."""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

import mpfjax
from mpfjax import enable_compilation_cache
from mpfjax.filter import Filter
from mpfjax.operations import compiling

SETTINGS = [
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
]


@pytest.fixture
def settings(monkeypatch, tmp_path):
    """JAX's settings, put back when the test ends, and a folder of caches of our own."""
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def test_a_program_is_found_again_after_all_are_forgotten(settings, tmp_path):
    hits = []
    jax.monitoring.register_event_listener(
        lambda event, **_: hits.append(event) if event.endswith("cache_hits") else None
    )
    jax.config.update("jax_compilation_cache_dir", None)
    assert enable_compilation_cache() == tmp_path / "caches" / "mpfjax"
    for is_kept in (False, True):
        jax.clear_caches()
        hits.clear()
        assert jax.jit(lambda x: 3 * x + 1.25)(jnp.float32(2.0)) == 7.25
        assert bool(hits) == is_kept


def test_the_folder_of_jax_is_used_if_it_has_one(settings, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "of jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 7.0)
    assert enable_compilation_cache() == tmp_path / "of jax"
    assert getattr(jax.config, SETTINGS[1]) == 0.0  # every program is kept


@pytest.mark.exactness
@pytest.mark.parametrize("transform", [eqx.Partial, eqx.filter_jit])
def test_a_step_says_what_it_saw_and_its_program_calls_nothing_back(transform):
    """No program with a call back into Python is kept for the next process."""
    filter = mpfjax.particle_filter(mpfjax.QuadraticModel(), 8)
    key, mixture = jax.random.key(0), filter.init(jax.random.key(0))
    program = eqx.filter_jit(Filter._step).lower(filter, key, mixture, jnp.ones(()))
    assert "callback" not in program.as_text()
    step = transform(lambda observation: filter.step(key, mixture, observation))
    assert step(jnp.ones(()))[0].num_particles == 8
    if transform is eqx.Partial:
        with pytest.raises(ValueError, match="observation: NaN or infinite"):
            step(jnp.full((), jnp.nan))
    else:
        assert step(jnp.full((), jnp.nan))[1].broken
    info = jax.vmap(step)(jnp.array([1.0, jnp.inf]))[1]
    np.testing.assert_array_equal(info.broken, [False, True])


def test_a_line_is_logged_while_a_program_is_compiled(monkeypatch, caplog):
    """Once for each function, however many shapes it is compiled for."""
    monkeypatch.setattr(compiling, "PATIENCE", 0.1)

    def slow(x):
        time.sleep(0.6)  # as it is traced
        return x + 1

    program = compiling.jit_on_wide_vectors(slow)
    program(jnp.ones(2))
    lines = [record.getMessage() for record in caplog.records if record.name == "mpfjax"]
    assert len(lines) == 1
    assert "slow for more than" in lines[0]
    assert "enable_compilation_cache" in lines[0]
    program(jnp.zeros(3))
    assert len([record for record in caplog.records if record.name == "mpfjax"]) == 1
