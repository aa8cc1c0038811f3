"""Functions are the same if they are the same object, and only then."""

import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from tests.user_models import TrickyQuadraticModel, nothing_traced

UNIT = 1.0


def by_globals():
    return lambda mixture: globals()["UNIT"] * mixture.mean()


def by_import():
    def collect(mixture):
        from units import UNIT  # pyright: ignore[reportMissingImports]

        return UNIT * mixture.mean()

    return collect


def means(collect):
    filter = mpfjax.particle_filter(TrickyQuadraticModel(), 20)
    return mpfjax.run_filter(jax.random.key(0), filter, jnp.ones(3), collect).collected


@pytest.mark.parametrize("written", [by_globals, by_import])
def test_one_text_written_twice_sees_what_it_names_each_time(written, monkeypatch):
    monkeypatch.setitem(sys.modules, "units", SimpleNamespace(UNIT=1.0))
    first = means(written())
    monkeypatch.setitem(sys.modules, "units", SimpleNamespace(UNIT=1000.0))
    monkeypatch.setitem(globals(), "UNIT", 1000.0)
    np.testing.assert_allclose(means(written()), 1000 * first, rtol=1e-5)


def test_one_object_compiles_once():
    collect = by_globals()
    means(collect)
    with nothing_traced():
        means(collect)
