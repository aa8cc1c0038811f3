"""Programs that several threads ask for at the same time."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np

from mpfjax.operations import compiling


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
