"""In float64 every filter and smoother of the registries runs, and nothing falls back to float32.

Types are settled as a program is traced, so most are traced and no more.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpfjax
from mpfjax.exact import grid_filter
from mpfjax.filter import Start
from mpfjax.observations import Series
from mpfjax.running.scan import scan
from mpfjax.tuning import Positive, particle_gibbs
from tests.marking import quick_of
from tests.precision import float64
from tests.registry import CHAINS, QUICK_CHAINS
from tests.smoothing.registry import CASES, SMOOTHERS

KEY = jax.random.key(0)
SQUARES = np.array([1.5, 1.0, np.nan, 0.9])
QUICK = [("backward sampling", "pf", "two modes"), ("conditional filter", "pf", "two modes")]


@pytest.fixture(autouse=True)
def double():
    with float64():
        yield


def quadratic():
    return mpfjax.QuadraticModel(0.3, 0.5, -2.0, 2.0)


def assert_double(tree):
    floats = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, np.floating)]
    assert floats
    assert {leaf.dtype for leaf in floats} == {np.dtype("float64")}


@pytest.mark.thorough
@pytest.mark.parametrize("chain", CHAINS)
def test_every_chain_is_traced(chain):
    filter, seen = CHAINS[chain](quadratic()), jnp.asarray(SQUARES)
    present = jnp.isfinite(seen)
    run = eqx.filter_eval_shape(
        lambda key: scan(Start(key), filter, Series(seen, present), None), KEY
    )
    assert_double(run)


@pytest.mark.thorough
@pytest.mark.parametrize("chain", [*QUICK_CHAINS, "guided mpf", "partitioned in clusters"])
def test_chains_of_each_kind_run(chain):
    """And Ẑ is unbiased where the chain is exact."""
    filter = CHAINS[chain](quadratic())
    keys = jax.random.split(KEY, 500)
    runs = mpfjax.monte_carlo(keys, filter, SQUARES, lambda mixture: None, missing="skip")
    assert_double(runs)
    if filter.approximate:
        return
    seen = SQUARES[[0, 1]]
    exact = grid_filter(quadratic(), jnp.asarray(seen), jnp.linspace(-5.0, 5.0, 1001))
    copies = getattr(filter.model, "num_objects", 1)
    log_evidence = np.sum(runs.log_likelihood_increments[:, :2], axis=1)
    ratios = np.exp(log_evidence - copies * float(exact.log_marginal_likelihood))
    assert abs(ratios.mean() - 1) < 4 * ratios.std() / np.sqrt(len(ratios))


def models():
    """Those of the smoothers' registry, made anew so that their numbers are float64."""
    one = {"A": [[0.9]], "Q": [[0.3]], "H": [[1.0]], "R": [[0.4]], "m0": [0.5], "P0": [[1.0]]}
    return {
        "one dimension": (mpfjax.LinearGaussianModel(**one), np.array([[0.8], [np.nan], [0.1]])),
        "two modes": (quadratic(), SQUARES),
    }


@pytest.mark.parametrize(
    ("name", "chain", "model"),
    quick_of(
        [
            case
            for case in CASES
            if case in QUICK
            or case[1:] == ("mpf", "one dimension")
            or (case[1] in ("guided pf", "dps") and case[2] == "two modes")
        ],
        QUICK,
    ),
)
def test_every_smoother_is_traced(name, chain, model):
    (model, seen), smoother = models()[model], SMOOTHERS[name]
    filter = CHAINS[chain](model)

    def rows(key):
        if smoother.of_run:
            run = mpfjax.run_filter(key, filter, seen, missing="skip")
            return smoother.of_run(key, filter.model, run)
        if smoother.online:
            return smoother.online(key, filter, seen)
        return smoother.kernel(key, filter, seen, trajectory)

    states = eqx.filter_eval_shape(filter.model.sample_initial, KEY, 1)
    trajectory = jnp.zeros((len(seen) + 1, *states.shape[1:]))
    assert_double(eqx.filter_eval_shape(rows, KEY))


@pytest.mark.thorough
def test_particle_gibbs_runs():
    chain = particle_gibbs(
        KEY, mpfjax.particle_filter(quadratic(), 8), SQUARES, 3, missing="skip",
        parameters={"sigma_y": lambda filter: filter.model.sigma_y},
        transforms={"sigma_y": Positive()}, proposal_deviations=0.1,
        log_prior=lambda parameters: -(parameters["sigma_y"] ** 2), progress=False,
    )  # fmt: skip
    assert chain.parameters["sigma_y"].dtype == np.float64
    assert np.isfinite(chain.parameters["sigma_y"]).all()
