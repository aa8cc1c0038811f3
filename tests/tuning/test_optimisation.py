"""`fit` finds the maximum, says what is wrong, and goes on where it was interrupted."""

import warnings
from functools import cache
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.scipy.stats import norm

import mpfjax
from mpfjax import Checkpoint
from mpfjax.exact import kalman_filter
from mpfjax.tuning import Interval, Positive, fit, maximise, standard_errors
from mpfjax.tuning.evidence import pose_evidence, warn_of_bias
from mpfjax.tuning.problem import averages, pose, scores
from tests.user_models import ScalarLinear

OBSERVATIONS = jnp.array([1.5, 0.2, -0.4, 0.8, 1.9, 1.1, 0.3, -0.9])
NOISE = {"r": lambda filter: filter.model.r}
ADAM = optax.adam(0.05)


class Normal(ScalarLinear):
    """With the density of x_0."""

    def log_initial(self, states):
        return norm.logpdf(states, self.m, self.p)


class Fragile(Normal):
    """A likelihood that breaks where its deviation falls below 0.3."""

    def log_likelihood(self, observation, states):
        honest = super().log_likelihood(observation, states)
        return jnp.where(self.r < 0.3, jnp.nan, honest)


def small(num_particles=16, gradient="stop", **parameters):
    return mpfjax.particle_filter(Fragile(**parameters), num_particles, gradient=gradient)


def short_fit(num_steps=6, *, parameters=NOISE, optimizer=ADAM, start=None, path=None, **options):
    options = {"num_seeds": 4, "progress": False, "transforms": {"r": Positive()}} | options
    arguments = {"key": jax.random.key(0), "observations": OBSERVATIONS}
    arguments |= {"filter": small(**(start or {})), "optimizer": optimizer, "num_steps": num_steps}
    checkpoint = None if path is None else Checkpoint(path)
    return fit(**arguments | {"parameters": parameters, "checkpoint": checkpoint} | options)


@pytest.mark.weekly
@pytest.mark.parametrize(("gradient", "score"), [("stop", "filter"), ("none", "fisher")])
def test_the_maximum_is_found_with_its_standard_errors(gradient, score):
    """On a linear-Gaussian model, whose likelihood the Kalman filter gives."""
    true = ScalarLinear().in_matrices()
    sequences = [mpfjax.simulate(jax.random.key(1), true, length)[1][:, 0] for length in (30, 20)]

    def log_evidence(reals):
        a, log_r = reals
        model = ScalarLinear(a=2 * jax.nn.sigmoid(a) - 1, r=jnp.exp(log_r)).in_matrices()
        runs = [kalman_filter(model, sequence[:, None]) for sequence in sequences]
        return sum(run.log_marginal_likelihood for run in runs)

    best, step = jnp.array([2.0, -0.7]), jax.jit(lambda x: newton(log_evidence, x))
    for _ in range(8):
        best = step(best)
    hessian = np.asarray(jax.hessian(log_evidence)(best), float)
    exact_error = np.sqrt(np.diag(np.linalg.inv(-hessian)))
    tuned = {
        "parameters": {n: lambda filter, n=n: getattr(filter.model, n) for n in ("a", "r")},
        "transforms": {"a": Interval(-1.0, 1.0), "r": Positive()}, "score": score,
    }  # fmt: skip
    run = fit(
        jax.random.key(1),
        mpfjax.particle_filter(Normal(a=0.3, r=1.5), 100, gradient=gradient),
        sequences, optax.sgd(optax.cosine_decay_schedule(0.06, 50)), 50,
        num_seeds=8, progress=False, **tuned,
    )  # fmt: skip
    errors = standard_errors(jax.random.key(2), run.tuned, sequences, num_seeds=64, **tuned)
    a, r = 2 / (1 + np.exp(-float(best[0]))) - 1, np.exp(float(best[1]))
    slope = np.array([(1 - a**2) / 2, r])
    found = np.array([run.parameters["a"], run.parameters["r"]])
    assert (np.abs(found - [a, r]) < 0.3 * slope * exact_error).all()
    np.testing.assert_allclose([errors["a"], errors["r"]], slope * exact_error, rtol=0.2)
    assert run.value == pytest.approx(float(log_evidence(best)), abs=2.0)
    assert run.stopped is None
    assert float(run.tuned.model.r) == pytest.approx(float(run.parameters["r"]))
    assert run.history["r"].shape == (50,)
    assert run.history["r"][0] == pytest.approx(1.5)


def newton(function, x):
    return x - jnp.linalg.solve(jax.hessian(function)(x), jax.grad(function)(x))


SEVERAL = [OBSERVATIONS, OBSERVATIONS[:1], OBSERVATIONS[::-1], OBSERVATIONS + 1, 2 * OBSERVATIONS]
STILL = optax.sgd(0.0)


class TestPooling:
    """Model parameters maximise Σ log mean Ẑ over seeds; a proposal's, the mean of log Ẑ."""

    def test_the_objective_is_the_jackknife_of_the_log_of_the_mean(self):
        """3 log (1/3 Σ Ẑ) - 2 times its mean over pairs of seeds, and the gradient of that."""
        problem = pose_evidence(small(8), SEVERAL, NOISE, {"r": Positive()})
        reals, keys = problem.start(), jax.random.split(jax.random.key(0), 3)

        def values(u):
            return jax.vmap(lambda key: problem.objective(key, problem.at({"r": u})))(keys)

        each, slopes = np.asarray(values(reals["r"])), np.asarray(jax.jacfwd(values)(reals["r"]))
        whole, pairs = [0, 1, 2], ([0, 1], [0, 2], [1, 2])

        def log_mean(seeds):
            return np.log(np.exp(each[seeds]).mean(axis=0))

        def slope(seeds):
            weights = np.exp(each[seeds]) / np.exp(each[seeds]).sum(axis=0)
            return (weights * slopes[seeds]).sum()

        expected = {False: (each.mean(axis=0), slopes.sum() / 3)}
        expected[True] = tuple(
            3 * f(whole) - 2 / 3 * sum(f(pair) for pair in pairs) for f in (log_mean, slope)
        )
        assert not np.allclose(*(value for value, _ in expected.values()), atol=0.01)
        for pooled, (value, derivative) in expected.items():
            found, gradient = scores(keys, problem, reals, pooled)
            np.testing.assert_allclose(found, each, rtol=1e-5)
            np.testing.assert_allclose(averages(found, pooled), value, rtol=1e-4)
            assert float(gradient["r"]) == pytest.approx(derivative, rel=1e-3)

    @pytest.mark.parametrize("other", [-1e3, -np.inf])
    def test_a_seed_far_above_the_others_has_a_finite_value_and_gradient(self, other):
        """Without the others there is nothing to correct by."""
        values = jnp.array([[0.5], [other], [other]])
        value, gradient = jax.value_and_grad(lambda v: averages(v, True)[0])(values)
        assert jnp.isfinite(value)
        np.testing.assert_allclose(jnp.sum(gradient), 1.0, rtol=1e-5)
        if np.isinf(other):
            assert value == pytest.approx(0.5 - np.log(3))

    def test_its_value_and_the_seeds_that_count_are_those_of_each_series(self):
        options = {"observations": SEVERAL, "optimizer": STILL, "start": {"num_particles": 4}}
        pooled, mean = (short_fit(1, pooled=pooled, **options) for pooled in (None, False))
        assert pooled.value > mean.value
        assert np.argmax(pooled.effective_seeds) == 1  # of the shortest
        assert pooled.effective_seeds.shape == (5,)
        assert (pooled.effective_seeds <= 4.001).all()
        np.testing.assert_array_equal(mean.effective_seeds, pooled.effective_seeds)

    @pytest.mark.exactness
    def test_by_default_a_proposal_alone_has_the_mean_of_the_logarithms(self):
        filter = mpfjax.particle_filter(ScalarLinear(), 8, proposal=proposal())
        options = {"filter": filter, "optimizer": STILL, "transforms": None}
        found = short_fit(1, parameters=WEIGHTS, **options).value
        assert found == short_fit(1, parameters=WEIGHTS, pooled=False, **options).value
        assert found < short_fit(1, parameters=WEIGHTS, pooled=True, **options).value

    def test_too_few_seeds_that_count_are_warned_of(self):
        narrow = {"filter": mpfjax.particle_filter(ScalarLinear(r=0.03), 4, gradient="stop")}
        with pytest.warns(UserWarning, match=r"fit: only 1\.\d of 4 seeds count .* deviation of"):
            short_fit(2, **narrow)
        with warnings.catch_warnings(action="error"):
            short_fit(2, pooled=False, **narrow)
            short_fit(2)


class Constant(ScalarLinear):
    """A likelihood that no state changes, so that Ẑ is exact: y_t ~ N(0, r²)."""

    def log_likelihood(self, observation, states):
        return norm.logpdf(observation, 0.0, self.r) + 0.0 * states


class TestBatches:
    OPTIONS: ClassVar = {
        "filter": mpfjax.particle_filter(Constant(), 2, gradient="stop"), "batch": 2,
        "observations": SEVERAL,
    }  # fmt: skip

    @pytest.mark.parametrize("batch", [2, 9])
    def test_an_epoch_holds_every_series_once_and_its_mean_gradient_is_that_of_all(self, batch):
        """Of four series of one shape and one of another: three parts, or two."""
        num_parts, exact = {2: 3, 9: 2}[batch], sum(norm.logpdf(y, 0, 0.5).sum() for y in SEVERAL)
        run = short_fit(4 * num_parts, optimizer=STILL, **self.OPTIONS | {"batch": batch})
        values = run.history["value"].reshape(4, num_parts)
        np.testing.assert_allclose(values.mean(axis=1), exact, rtol=1e-5)
        assert run.value == pytest.approx(float(exact), rel=1e-5)
        assert len({*map(tuple, values.round(3))}) > 1  # in another order
        np.testing.assert_allclose(run.effective_seeds, 4, rtol=1e-5)
        whole = short_fit(1, optimizer=optax.sgd(1e-6), **self.OPTIONS | {"batch": None})
        epoch = short_fit(num_parts, optimizer=optax.sgd(1e-6), **self.OPTIONS | {"batch": batch})
        moved = [np.log(run.parameters["r"] / 0.5) for run in (epoch, whole)]
        assert moved[0] == pytest.approx(num_parts * moved[1], rel=0.05)

    def test_in_the_middle_of_an_epoch_it_goes_on_where_it_was(self, tmp_path):
        kept = self.OPTIONS | {"path": tmp_path / "fit.npz"}
        short_fit(4, **kept)
        assert_same(short_fit(7, **kept), short_fit(7, **self.OPTIONS))
        with pytest.raises(ValueError, match="batch is 2 there and 3 here"):
            short_fit(7, **kept | {"batch": 3})


@pytest.mark.exactness
def test_standard_errors_are_of_all_series():
    """Where Ẑ is exact, they are r / sqrt(2 n) at the maximum, of n observations."""
    rows = [y.astype(float) for y in np.random.default_rng(0).normal(size=(5, 40))]
    r = float(np.sqrt(np.mean(np.square(rows))))
    filter = mpfjax.particle_filter(Constant(r=r), 2, gradient="stop")
    found = standard_errors(jax.random.key(0), filter, rows, parameters=NOISE, num_seeds=20)
    assert found["r"] == pytest.approx(r / np.sqrt(2 * 200), rel=0.02)


@pytest.mark.exactness
def test_away_from_a_maximum_there_are_no_standard_errors():
    with pytest.warns(UserWarning, match="no maximum here"):
        none = standard_errors(
            jax.random.key(0), small(r=4.0), OBSERVATIONS, parameters=NOISE, num_seeds=4
        )
    assert none is None


class TestResuming:
    @pytest.mark.exactness
    @pytest.mark.parametrize(
        ("other", "named"),
        [
            ({"num_seeds": 2}, "num_seeds is 4 there and 2 here"),
            ({"score": "fisher"}, "score is filter there and fisher here"),
            ({"start": {"r": 0.7}}, r"filter\.model\.r is .* 0\.5 there and .* 0\.7 here"),
            ({"start": {"num_particles": 8}}, r"filter\.num_particles is 16 there and 8 here"),
            ({"observations": OBSERVATIONS.at[3].add(1e-6)}, r"observations.* is"),
            ({"key": jax.random.key(1)}, "key is"),
            ({"transforms": {"r": Interval(0.0, 9.0)}}, r"transforms\['r'\]"),
            ({"parameters": {"r": lambda filter: filter.model.q}}, r"parameters\['r'\] is"),
        ],
    )
    def test_a_checkpoint_of_another_fit_is_refused_with_what_differs(self, tmp_path, other, named):
        short_fit(1, path=tmp_path / "fit.npz")
        with pytest.raises(
            ValueError, match=r"checkpoint: .*fit\.npz is of another fit: .*" + named
        ):
            short_fit(path=tmp_path / "fit.npz", **other)

    @pytest.mark.parametrize(("num_steps", "step", "last"), [(6, 0.2, 3), (1, 1.0, 1)])
    def test_a_fit_that_broke_has_the_last_good_parameters_and_stays(
        self, tmp_path, num_steps, step, last
    ):
        """In the middle, or where its end was evaluated."""
        options = {"optimizer": falling(step), "path": tmp_path / "fit.npz"}
        with pytest.warns(UserWarning, match=f"was nan at step {last}"):
            first = short_fit(num_steps, **options)
        assert first.stopped == f"the log marginal likelihood was nan at step {last}"
        expected = 0.5 * np.exp(-step * np.arange(last))
        np.testing.assert_allclose(first.history["r"], expected, rtol=1e-5)
        assert first.parameters["r"] == pytest.approx(expected[-1])
        assert np.isfinite(first.value)
        before = (tmp_path / "fit.npz").read_bytes()
        with pytest.warns(UserWarning, match="was nan at step"):
            assert_same(short_fit(num_steps + 5, **options), first)
        assert (tmp_path / "fit.npz").read_bytes() == before


def assert_same(run, other):
    """To the bit, and neither has taken a step more."""
    assert run.parameters["r"] == other.parameters["r"]
    assert run.value == other.value
    assert run.stopped == other.stopped
    for name, values in other.history.items():
        np.testing.assert_array_equal(run.history[name], values)


def test_a_start_without_a_likelihood_is_an_error():
    with pytest.raises(RuntimeError, match="was nan at the start"):
        short_fit(start={"r": 0.2})


def falling(step):
    """An optimiser that takes the same step down whatever the gradient is."""
    return optax.stateless(lambda updates, _: jax.tree.map(lambda u: 0 * u - step, updates))


class TestAnyObjective:
    def ascent(self, num_steps, noise=0.0, **options):
        def parabola(key, model):
            return noise * jax.random.normal(key) - (model.r - 3.0) ** 2

        arguments = jax.random.key(0), ScalarLinear(r=1.0), parabola, optax.sgd(0.1), num_steps
        options |= {"parameters": {"r": lambda model: model.r}, "progress": False}
        return maximise(*arguments, **options)

    def test_a_function_is_an_objective(self):
        run = self.ascent(60)
        assert run.parameters["r"] == run.tuned.r == pytest.approx(3.0, abs=1e-3)
        np.testing.assert_allclose(run.history["r"][:2], [1.0, 1.4], rtol=1e-5)
        assert run.value == pytest.approx(0.0, abs=1e-4)

    def test_it_is_averaged_over_seeds(self):
        run = self.ascent(30, noise=1.0, num_seeds=200)
        assert np.abs(run.history["deviation"] - 1.0).max() < 0.25  # five standard errors


class Plain(ScalarLinear):
    """Fields as a user writes them who knows nothing of arrays: floats, a count, a constant."""

    r: float = 0.5
    h: float = 1.0
    order: int = 3
    q: float = eqx.field(static=True, default=0.6)


@pytest.mark.exactness
def test_python_floats_are_tuned_like_arrays_where_they_are_named():
    def history(model):
        filter = mpfjax.particle_filter(model, 16, gradient="stop")
        options = {"parameters": NOISE, "num_seeds": 4, "progress": False}
        return fit(jax.random.key(0), filter, OBSERVATIONS, ADAM, 3, **options).history["r"]

    found = history(Plain())
    np.testing.assert_allclose(found, history(ScalarLinear()), rtol=1e-5)
    assert len(set(found)) == 3


WEIGHTS = {"w": lambda filter: filter.moves[1].proposal.network}


@cache
def proposal():
    return mpfjax.NetworkProposal.create(jax.random.key(0), 1, 1, 0.8)


class TestBias:
    """A filter whose resampling has no gradient is tuned with a warning."""

    def warn(self, filter, parameters=NOISE):
        warn_of_bias("fit", pose(filter, len, parameters, None))

    @pytest.mark.parametrize("parameters", [NOISE, NOISE | WEIGHTS])
    def test_the_default_is_warned_of_also_beside_a_proposal(self, parameters):
        filter = mpfjax.particle_filter(ScalarLinear(), 16, proposal=proposal())
        with pytest.warns(UserWarning, match='fit: .* score of r is biased.*gradient="stop"'):
            self.warn(filter, parameters)

    def test_a_draw_that_is_kept_of_several_biases_it(self):
        moves = [mpfjax.Resample(gradient="stop"), mpfjax.PropagateNested(mpfjax.Propagate(), 2)]
        with pytest.warns(UserWarning, match="fit: PropagateNested has no gradient"):
            self.warn(mpfjax.Filter(ScalarLinear(), moves, 16))

    @pytest.mark.exactness
    def test_what_is_right_is_not(self):
        with warnings.catch_warnings(action="error"):
            self.warn(mpfjax.particle_filter(ScalarLinear(), 16, gradient="stop"))
            learning = mpfjax.particle_filter(ScalarLinear(), 16, proposal=proposal())
            self.warn(learning, WEIGHTS)
            self.warn(mpfjax.particle_filter(ScalarLinear(), 16, ess_threshold=0.0))
            self.warn(mpfjax.Filter(ScalarLinear(), [mpfjax.Propagate()], 16))
