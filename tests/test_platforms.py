"""What would run on a GPU: its forms are lowered for one, and give the same numbers here."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import mpfjax
from mpfjax.observations import Series
from mpfjax.operations import stored as forms
from mpfjax.operations.prefix_sums import count_upto, exact_sum_before, sum_before
from mpfjax.operations.stored import stored
from mpfjax.running.scan import scan
from tests.marking import weekly
from tests.registry import CHAINS

MODEL = mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)
OBSERVATIONS = jnp.array([1.5, 1.0, 0.4])
VALUES = jnp.abs(jnp.sin(jnp.arange(200.0)))
FORMS = {
    "sum_before": lambda: sum_before(VALUES),
    "exact_sum_before": lambda: exact_sum_before(VALUES),
    "count_upto": lambda: count_upto((VALUES > 0.5).astype(jnp.int32), 200),
    "stored": lambda: stored(jnp.arange(200, dtype=jnp.int32)),
    "normal": lambda: mpfjax.normal(jax.random.key(0), (200,)),
    "resample": lambda: (
        mpfjax.Resample()(
            jax.random.key(0), CHAINS["mpf"](MODEL).init(jax.random.key(1))
        ).ancestor_indices
    ),
}


@contextlib.contextmanager
def default_forms():
    """Within it the default forms run on a CPU as well, so that they can be tried without a GPU."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(forms, "_only_the_default_forms", True)
        jax.clear_caches()
        yield
    jax.clear_caches()


@pytest.mark.parametrize("form", FORMS)
def test_every_form_has_one_for_a_gpu_and_it_gives_the_same(form):
    own = jax.jit(FORMS[form])()
    lowered = export.export(jax.jit(FORMS[form]), platforms=["cuda"])()
    assert lowered.platforms == ("cuda",)
    with default_forms():
        other = jax.jit(FORMS[form])()
        text = jax.jit(FORMS[form]).lower().as_text()
    # The triangle and the identity matrix are what makes a CPU fast.
    assert "dot_general" not in text
    for one, two in zip(jax.tree.leaves(own), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-5, atol=1e-6)


def test_a_whole_filter_is_lowered_for_a_gpu():
    """But for the error that a broken density raises, which needs the GPU itself."""
    filter = CHAINS["mpf"](MODEL)

    def run(key):
        return scan(key, filter, Series(OBSERVATIONS), None).log_marginal_likelihood

    lowered = export.export(jax.jit(run), platforms=["cuda"])(jax.random.key(0))
    assert lowered.platforms == ("cuda",)


@pytest.mark.parametrize("chain", ["pf", *weekly(name for name in CHAINS if name != "pf")])
def test_a_chain_on_the_default_forms_is_the_same_filter(chain):
    """Most runs; in the others a particle stands on the border between two offspring.

    Under "ssp" that is where the last two fractions sum to one, in three runs of ten.
    """
    filter = CHAINS[chain](MODEL)
    keys = jax.random.split(jax.random.key(2), 40)

    def increments():
        run = mpfjax.monte_carlo(keys, filter, OBSERVATIONS, lambda mixture: None)
        return np.asarray(run.log_likelihood_increments)

    own = increments()
    with default_forms():
        other = increments()
    same = np.isclose(own, other, rtol=1e-3, atol=1e-3).all(axis=1)
    assert same.mean() > 0.5, own - other
