"""`fit` finds the maximum, says what is wrong, and goes on where it was interrupted."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.optimize import minimize

import mpfjax
from mpfjax.exact import kalman_filter
from mpfjax.tuning import Interval, Positive, fit, standard_errors
from tests.full_disk import no_room_beyond
from tests.user_models import ScalarLinear

OBSERVATIONS = jnp.array([1.5, 0.2, -0.4, 0.8, 1.9, 1.1, 0.3, -0.9])
NOISE = {"r": lambda filter: filter.model.r}
ADAM = optax.adam(0.05)


class Fragile(ScalarLinear):
    """A likelihood that breaks where its deviation falls below 0.3, and a parameter to no end."""

    idle: jax.Array = eqx.field(converter=jnp.asarray, default=1.0)

    def log_likelihood(self, observation, states):
        honest = super().log_likelihood(observation, states)
        return jnp.where(self.r < 0.3, jnp.nan, honest)


def small(**parameters):
    return mpfjax.particle_filter(Fragile(**parameters), 16, gradient="stop")


def short_fit(num_steps=6, *, parameters=NOISE, optimizer=ADAM, start=None, **options):
    options = {"num_seeds": 4, "progress": False, "transforms": {"r": Positive()}} | options
    filter = small(**(start or {}))
    key = jax.random.key(0)
    return fit(key, filter, OBSERVATIONS, optimizer, num_steps, parameters=parameters, **options)


@pytest.fixture(scope="module")
def sequences():
    rng = np.random.default_rng(0)
    sequences = []
    for length in (60, 40):
        state, rows = 0.5, []
        for _ in range(length):
            state = 0.9 * state + 0.6 * rng.normal()
            rows.append(state + 0.5 * rng.normal())
        sequences.append(jnp.array(rows))
    return sequences


class TestMaximum:
    """On a linear-Gaussian model, whose likelihood the Kalman filter gives."""

    NAMES = ("a", "r")

    def log_evidence(self, reals, sequences):
        a, log_r = reals
        model = ScalarLinear(a=2 * jax.nn.sigmoid(a) - 1, r=jnp.exp(log_r)).in_matrices()
        runs = [kalman_filter(model, sequence[:, None]) for sequence in sequences]
        return sum(run.log_marginal_likelihood for run in runs)

    def test_is_found_with_its_standard_errors(self, sequences):
        start = jnp.zeros(2)
        value = jax.jit(jax.value_and_grad(lambda reals: -self.log_evidence(reals, sequences)))
        best = minimize(
            lambda x: tuple(np.asarray(v, float) for v in value(jnp.asarray(x, jnp.float32))),
            np.asarray(start), jac=True, method="BFGS",
        ).x  # fmt: skip
        hessian = jax.hessian(self.log_evidence)(jnp.asarray(best, jnp.float32), sequences)
        exact_error = np.sqrt(np.diag(np.linalg.inv(-np.asarray(hessian))))
        run = fit(
            jax.random.key(1),
            mpfjax.particle_filter(ScalarLinear(a=0.3, r=1.5), 200, gradient="stop"),
            sequences,
            optax.sgd(optax.cosine_decay_schedule(0.03, 60)),
            60,
            parameters={n: lambda filter, n=n: getattr(filter.model, n) for n in self.NAMES},
            transforms={"a": Interval(-1.0, 1.0), "r": Positive()},
            num_seeds=8,
            curvature_seeds=32,
            progress=False,
        )
        a, r = 2 / (1 + np.exp(-best[0])) - 1, np.exp(best[1])
        # Within a third of a standard error, which the seeds of the last steps leave.
        slope = np.array([(1 - a**2) / 2, r])
        found = np.array([run.parameters["a"], run.parameters["r"]])
        assert (np.abs(found - [a, r]) < 0.3 * slope * exact_error).all()
        assert run.standard_errors is not None
        errors = np.array([run.standard_errors["a"], run.standard_errors["r"]])
        np.testing.assert_allclose(errors, slope * exact_error, rtol=0.2)
        expected = float(self.log_evidence(jnp.asarray(best, jnp.float32), sequences))
        assert run.log_marginal_likelihood == pytest.approx(expected, abs=2.0)
        assert run.stopped is None
        assert float(run.filter.model.r) == pytest.approx(float(run.parameters["r"]))
        assert run.history["r"].shape == (60,)
        assert run.history["r"][0] == pytest.approx(1.5)

    def test_away_from_one_there_are_no_standard_errors(self):
        with pytest.warns(UserWarning, match="no maximum here"):
            none = standard_errors(
                jax.random.key(0), small(r=4.0), OBSERVATIONS, parameters=NOISE, num_seeds=4
            )
        assert none is None


class TestResuming:
    def test_an_interrupted_fit_ends_as_if_it_had_not_been(self, tmp_path):
        whole = short_fit()
        short_fit(3, checkpoint=tmp_path / "fit.npz")
        resumed = short_fit(checkpoint=tmp_path / "fit.npz")
        assert resumed.parameters["r"] == whole.parameters["r"]
        for name, values in whole.history.items():
            np.testing.assert_array_equal(resumed.history[name], values)
        assert resumed.log_marginal_likelihood == whole.log_marginal_likelihood

    def test_what_is_done_is_kept_where_it_is_interrupted(self, tmp_path, monkeypatch):
        real, path = mpfjax.tuning.climb.scores, tmp_path / "fit.npz"
        calls = []

        def interrupted(*arguments):
            calls.append(arguments)
            if len(calls) == 4:
                raise KeyboardInterrupt
            return real(*arguments)

        monkeypatch.setattr(mpfjax.tuning.climb, "scores", interrupted)
        with pytest.raises(KeyboardInterrupt):
            short_fit(checkpoint=path)
        with np.load(path, allow_pickle=False) as file:
            assert int(file["step"]) == 3
        monkeypatch.undo()
        assert short_fit(checkpoint=path).parameters["r"] == short_fit().parameters["r"]

    @pytest.mark.parametrize(
        "other", [{"num_seeds": 2}, {"start": {"r": 0.7}}, {"optimizer": optax.sgd(0.1)}]
    )
    def test_a_checkpoint_of_another_fit_is_refused(self, tmp_path, other):
        short_fit(1, checkpoint=tmp_path / "fit.npz")
        with pytest.raises(ValueError, match=r"checkpoint: .* is of another fit"):
            short_fit(checkpoint=tmp_path / "fit.npz", **other)

    def test_a_checkpoint_that_is_cut_off_is_named_and_left_alone(self, tmp_path):
        path = tmp_path / "fit.npz"
        short_fit(1, checkpoint=path)
        path.write_bytes(path.read_bytes()[:500])
        with pytest.raises(ValueError, match=r"fit\.npz: cut off"):
            short_fit(checkpoint=path)
        assert path.stat().st_size == 500

    def test_a_full_disk_leaves_the_last_checkpoint(self, tmp_path):
        path = tmp_path / "fit.npz"
        short_fit(2, checkpoint=path)
        before = path.read_bytes()
        with pytest.raises(OSError, match=r"fit\.npz"), no_room_beyond(500):
            short_fit(checkpoint=path)
        assert path.read_bytes() == before


class TestStopping:
    def test_a_nan_ends_it_with_the_last_good_parameters_and_the_step(self):
        with pytest.warns(UserWarning, match="was nan at step 3"):
            run = short_fit(optimizer=falling(0.2))
        assert run.stopped == "the log marginal likelihood was nan at step 3"
        expected = 0.5 * np.exp([0.0, -0.2, -0.4])
        np.testing.assert_allclose(run.history["r"], expected, rtol=1e-5)
        assert run.parameters["r"] == pytest.approx(expected[-1])
        assert np.isfinite(run.log_marginal_likelihood)

    def test_a_nan_after_the_last_step_counts_too(self):
        with pytest.warns(UserWarning, match="was nan at step 1"):
            run = short_fit(1, optimizer=falling(1.0))
        assert run.parameters["r"] == pytest.approx(0.5)

    def test_a_start_without_a_likelihood_is_an_error(self):
        with pytest.raises(RuntimeError, match="was nan at the start"):
            short_fit(start={"r": 0.2})

    def test_patience_ends_what_no_longer_climbs(self):
        run = short_fit(40, optimizer=optax.sgd(0.0), patience=3, common_random_numbers=True)
        assert len(run.history["r"]) == 6
        assert "3 steps gained" in run.stopped


def falling(step):
    """An optimiser that takes the same step down whatever the gradient is."""
    return optax.stateless(lambda updates, _: jax.tree.map(lambda u: 0 * u - step, updates))


def test_common_random_numbers_are_the_same_at_every_step():
    still = optax.sgd(0.0)
    same = short_fit(3, optimizer=still, common_random_numbers=True)
    assert len(set(same.history["log_marginal_likelihood"])) == 1
    fresh = short_fit(3, optimizer=still)
    assert len(set(fresh.history["log_marginal_likelihood"])) == 3


def test_parameters_can_be_all_of_the_model_or_a_filter_spec():
    filter = mpfjax.particle_filter(ScalarLinear(), 16, gradient="stop")
    everything = fit(jax.random.key(0), filter, OBSERVATIONS, ADAM, 1, num_seeds=2, progress=False)
    assert everything.parameters.keys() == set("aqhrmp")
    spec = eqx.tree_at(lambda f: f.model.q, jax.tree.map(lambda _: False, filter), True)
    one = fit(
        jax.random.key(0), filter, OBSERVATIONS, ADAM, 1, parameters=spec, num_seeds=2,
        progress=False,
    )  # fmt: skip
    assert one.parameters.keys() == {"q"}
    assert one.filter.model.a == filter.model.a


def test_the_bar_shows_the_steps(capsys):
    short_fit(2, progress=True)
    assert "2/2" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"num_steps": 0}, "num_steps: 0"),
        ({"num_seeds": 0}, "num_seeds: 0"),
        ({"patience": 0}, "patience: 0"),
        ({"curvature_seeds": -1}, "curvature_seeds: -1"),
        ({"start": {"r": -0.5}}, r"parameters: r starts at -0.5, outside Positive"),
        ({"parameters": {"idle": lambda f: f.model.idle}, "transforms": {}}, "depend on idle"),
        ({"transforms": {"sigma": Positive()}}, r"transforms: \['sigma'\]"),
        ({"parameters": {}}, "parameters: there is nothing"),
        (
            {"parameters": {"n": lambda f: f.num_particles}, "transforms": {}},
            "parameters: n picks 16",
        ),
        ({"parameters": {"all": True}}, "parameters: all"),
    ],
)
def test_bad_arguments_are_refused_by_name(options, named):
    with pytest.raises(ValueError, match=named):
        short_fit(**options)


def test_bad_sequences_are_refused():
    for observations in ([], [OBSERVATIONS, OBSERVATIONS.at[1].set(jnp.nan)]):
        with pytest.raises(ValueError, match="observations: "):
            fit(jax.random.key(0), small(), observations, ADAM, 1, parameters=NOISE)
