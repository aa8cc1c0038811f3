"""Programs that several threads ask for at the same time."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from mpfjax.operations import compiling
from mpfjax.running import devices as on_threads


def test_threads_that_come_first_share_one_program(monkeypatch):
    """Each once made a jitted function of its own, and now and then a first call took twice as long
    for it."""
    options, made = compiling.cpu_options, []

    def slowly(**settings):
        made.append(threading.get_ident())
        time.sleep(0.2)  # the others come meanwhile
        return options(**settings)

    monkeypatch.setattr(compiling, "cpu_options", slowly)
    compiled = compiling.jit_on_wide_vectors(lambda values: 3 * values)
    values, start = jnp.arange(4.0), threading.Barrier(3)

    def call(_):
        start.wait()
        return compiled(values)

    with ThreadPoolExecutor(3) as threads:
        for found in threads.map(call, range(3)):
            np.testing.assert_array_equal(found, 3 * np.arange(4.0))
    assert len(made) == 1


@pytest.mark.parametrize(
    ("num_processors", "one_thread"), [(1, True), (2, True), (3, False), (64, False)]
)
def test_a_program_uses_all_threads_unless_each_processor_has_one(
    monkeypatch, num_processors, one_thread
):
    """Five inputs on two threads: on three processors and more, one would be idle otherwise."""
    used = []
    for name in ("_run_block", "_run_block_on_one"):
        monkeypatch.setattr(
            on_threads, name, partial(_noted, used, name, getattr(on_threads, name))
        )
    monkeypatch.setattr(on_threads, "num_processors", lambda: num_processors)
    found = on_threads.over_threads(lambda values: values**2, jnp.arange(5.0), (), 2)
    np.testing.assert_array_equal(found, np.arange(5.0) ** 2)
    assert set(used) == {"_run_block_on_one" if one_thread else "_run_block"}


def _noted(used, name, program, *arguments):
    used.append(name)
    return program(*arguments)
