"""What would run on a GPU: its forms are lowered for one, and give the same numbers here."""

import contextlib

import chex
import jax
import jax.numpy as jnp
import pytest
from jax import export

import mpfjax
from mpfjax.models.observations import Series
from mpfjax.operations import stored as forms
from mpfjax.operations.prefix_sums import count_upto, sum_before
from mpfjax.operations.stored import stored
from mpfjax.running.scan import scan
from tests.marking import quick_of

MODEL = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
FILTER = mpfjax.mixture_particle_filter(MODEL, 40, 3)
OBSERVATIONS = Series(jnp.array([1.5, 1.0, 0.4]))
VALUES = jnp.abs(jnp.sin(jnp.arange(200.0)))
KEY = jax.random.key(0)
FORMS = {
    "sum_before": lambda: sum_before(VALUES),
    "count_upto": lambda: count_upto((VALUES > 0.5).astype(jnp.int32), 200),
    "stored": lambda: stored(jnp.arange(200, dtype=jnp.int32)),
    "normal": lambda: mpfjax.normal(KEY, (200,)),
    "a filter": lambda: scan(KEY, FILTER, OBSERVATIONS, None).log_likelihood_increments,
}


@contextlib.contextmanager
def default_forms():
    """Within it the default forms run on a CPU as well, so that they can be tried without a GPU."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(forms, "_only_the_default_forms", True)
        jax.clear_caches()
        yield
    jax.clear_caches()


@pytest.mark.parametrize("form", quick_of(FORMS, list(FORMS)[:-1]))
def test_every_form_has_one_for_a_gpu_and_it_gives_the_same(form):
    """The triangle and the identity matrix are what makes a CPU fast."""
    own = jax.jit(FORMS[form])()
    lowered = export.export(jax.jit(FORMS[form]), platforms=["cuda"])()
    assert lowered.platforms == ("cuda",)
    with default_forms():
        other = jax.jit(FORMS[form])()
        text = jax.jit(FORMS[form]).lower().as_text()
    assert form == "a filter" or "dot_general" not in text
    chex.assert_trees_all_close(own, other, rtol=1e-5, atol=1e-5)
