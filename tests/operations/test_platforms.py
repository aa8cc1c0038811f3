"""What would run on a GPU or a TPU: programs are lowered for one, forms give the same here."""

import contextlib

import chex
import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from jax import export

import mpfjax
from mpfjax import smoothing
from mpfjax.models.series import Series
from mpfjax.operations import stored as forms
from mpfjax.operations.prefix_sums import count_upto, sum_before
from mpfjax.operations.stored import stored
from mpfjax.running.scan import scan
from tests.marking import quick_of
from tests.matrix.data import case
from tests.matrix.filters import FILTERS, MOVES, RECIPES, SINGLE
from tests.matrix.table import rules_of

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


SERIES = case("inputs", "complete").series


def form_of(filter):
    """The first form of the matrix that the filter is for."""
    forms = ("inputs", "one of several", "targets", "switching")
    return next(form for form in forms if not rules_of(form, "complete", filter, "log Z"))


def log_likelihood(name):
    example = case(form_of(name), "complete")
    filter = FILTERS[name](example.model)
    return lambda key: mpfjax.run_filter(key, filter, example.series).log_marginal_likelihood


def of_run(smooth):
    filter = FILTERS["mixture"](case("inputs", "complete").model)
    return lambda key: smooth(key, filter, mpfjax.run_filter(key, filter, SERIES))


def score(key):
    """The gradient by which `fit` takes a step."""
    model = case("inputs", "complete").model

    def value(model):
        filter = FILTERS["with score"](model)
        return mpfjax.run_filter(key, filter, SERIES).log_marginal_likelihood

    return eqx.filter_grad(value)(model)


def trajectories(**options):
    return of_run(
        lambda key, filter, run: smoothing.sample_trajectories(
            key, filter, run, 3, inputs=SERIES.inputs, **options
        )
    )


def sums(key, filter, run):
    return smoothing.smoothed_sums(key, filter, SERIES, lambda before, now: now).sums


PROGRAMS = {
    "trajectories": trajectories(),
    "trajectories, mcmc": trajectories(method="mcmc"),
    "genealogy": of_run(lambda key, filter, run: smoothing.trace_ancestors(run).trajectories),
    "sums": of_run(sums),
    "a gradient": score,
}


@pytest.mark.parametrize(
    "name",
    [
        *quick_of([*RECIPES, *SINGLE, *MOVES], ["with restarts"], one_in=8),
        *quick_of(PROGRAMS, [], one_in=3),
    ],
)
def test_programs_are_for_any_device(name):
    """They call nothing back, and compute in float32."""
    program = PROGRAMS.get(name) or log_likelihood(name)

    def of_words(words):
        return program(jax.random.wrap_key_data(words))

    words = jax.random.key_data(KEY)
    exported = export.export(jax.jit(of_words), platforms=["cuda", "tpu"])(words)
    text = exported.mlir_module()
    assert "callback" not in text
    assert "f64" not in text
