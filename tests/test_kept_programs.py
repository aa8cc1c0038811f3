"""Programs that a later process starts without tracing them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from mpfjax.operations import kept_programs
from mpfjax.operations.kept_programs import kept_program
from mpfjax.vision.tracking.track import track

TRACED = []


def noisy_sum(fixed, key, values):
    TRACED.append(1)
    return {"sum": fixed["scale"] * values + jax.random.normal(key), "name": fixed["name"]}


def with_a_callback(values):
    jax.debug.callback(lambda _: None, values)
    return values + 1


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder of programs, in which those of this file are kept as the library's are.

    JAX's own cache is off: what it has found is not written out once more.
    """
    monkeypatch.setattr(kept_programs, "kept_folder", lambda: tmp_path)
    monkeypatch.setattr(kept_programs, "_KNOWN", {*kept_programs._KNOWN, "tests"})
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()
    yield tmp_path
    jax.config.update("jax_enable_compilation_cache", True)
    compilation_cache.reset_cache()


def run(scale=2.0, name="a", size=3):
    """The function on fresh arrays; also how often it was traced for that."""
    TRACED.clear()
    jax.clear_caches()
    moving = (jax.random.key(1), np.arange(size, dtype=np.float32))
    call = kept_program(noisy_sum, ({"scale": jnp.float32(scale), "name": name},), moving)
    return call(*moving), len(TRACED)


def expected(scale=2.0, name="a", size=3):
    noise = jax.random.normal(jax.random.key(1))
    return {"sum": scale * jnp.arange(size, dtype=jnp.float32) + noise, "name": name}


def is_as_expected(found, **named):
    right = expected(**named)
    return found["name"] == right["name"] and np.allclose(found["sum"], right["sum"])


def test_a_program_is_traced_once_for_all_values_and_again_for_other_types(folder):
    for arguments, traces in [
        ({}, 1),
        ({}, 0),
        ({"scale": 5.0}, 0),
        ({"size": 4}, 1),
        ({"name": "b"}, 1),
    ]:
        found, traced = run(**arguments)
        assert is_as_expected(found, **arguments)
        assert traced == traces
    assert len(list(folder.iterdir())) == 3


def test_a_call_of_another_shape_is_compiled_beside_it(folder):
    moving = (jax.random.key(1), jnp.arange(3.0))
    call = kept_program(noisy_sum, ({"scale": jnp.float32(2.0), "name": "a"},), moving)
    for size in (3, 4, 3):
        assert is_as_expected(call(moving[0], jnp.arange(float(size))), size=size)


def test_a_file_that_cannot_be_read_is_written_anew(folder):
    run()
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    for broken in (b"", b"no pickle", whole[: len(whole) // 2]):
        path.write_bytes(broken)
        assert is_as_expected(run()[0])
        assert run()[1] == 0


def test_other_code_than_the_librarys_is_not_kept_nor_are_callbacks(folder, monkeypatch):
    values = jnp.arange(3.0)
    assert np.allclose(kept_program(with_a_callback, (), (values,))(values), values + 1)
    monkeypatch.setattr(kept_programs, "_KNOWN", kept_programs._KNOWN - {"tests"})
    assert is_as_expected(run()[0])
    assert not list(folder.iterdir())


@pytest.mark.thorough
def test_the_tracker_says_the_same_from_a_kept_program(folder, monkeypatch):
    rows = np.array([[t, -1, 10.0 + t, 20, 30, 60, 1] for t in range(1, 7)])
    found = [list(track(None, rows)) for _ in range(2)]
    assert len(list(folder.iterdir())) == 1
    monkeypatch.setattr(kept_programs, "kept_folder", lambda: None)
    plain = list(track(None, rows))
    for kept in found:
        for one, other in zip(kept, plain, strict=True):
            assert all(map(np.array_equal, one, other))


def test_a_program_of_other_source_is_kept_though_jax_has_found_its_operations(
    folder, monkeypatch, tmp_path_factory
):
    """After an upgrade of the library that leaves a program as it is."""
    of_jax = {
        "jax_compilation_cache_dir": str(tmp_path_factory.mktemp("jax")),
        "jax_persistent_cache_min_compile_time_secs": 0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
        "jax_enable_compilation_cache": True,
    }
    before = {name: jax.config.values[name] for name in of_jax}
    try:
        for name, value in of_jax.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()
        run()
        monkeypatch.setattr(kept_programs, "_versions", lambda: b"another")
        assert run()[1] == 1
        assert run()[1] == 0
        assert len(list(folder.glob("mpfjax-*"))) == 2
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
