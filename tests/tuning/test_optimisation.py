"""`fit` finds the maximum, says what is wrong, and goes on where it was interrupted."""

import functools
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.optimize import minimize

import mpfjax
from mpfjax import Checkpoint
from mpfjax.exact import kalman_filter
from mpfjax.running.storage import load_arrays, program_of, write_arrays
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


def small(num_particles=16, gradient="stop", **parameters):
    return mpfjax.particle_filter(Fragile(**parameters), num_particles, gradient=gradient)


def short_fit(num_steps=6, *, parameters=NOISE, optimizer=ADAM, start=None, **options):
    options = {"num_seeds": 4, "progress": False, "transforms": {"r": Positive()}} | options
    arguments = {"key": jax.random.key(0), "observations": OBSERVATIONS}
    arguments |= {"filter": small(**(start or {})), "optimizer": optimizer, "num_steps": num_steps}
    return fit(**arguments | {"parameters": parameters} | options)


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

    @pytest.mark.thorough
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
        short_fit(3, checkpoint=Checkpoint(tmp_path / "fit.npz"))
        assert_same(short_fit(checkpoint=Checkpoint(tmp_path / "fit.npz")), whole)

    def test_what_is_done_is_kept_where_it_is_interrupted(self, tmp_path, monkeypatch):
        real, path = mpfjax.tuning.optimisation.scores, tmp_path / "fit.npz"
        calls = []

        def interrupted(*arguments):
            calls.append(arguments)
            if len(calls) == 4:
                raise KeyboardInterrupt
            return real(*arguments)

        monkeypatch.setattr(mpfjax.tuning.optimisation, "scores", interrupted)
        with pytest.warns(UserWarning, match="fit: interrupted at step 3 of 6"):
            part = short_fit(checkpoint=Checkpoint(path))
        assert notes_of(path)["step"] == 3
        monkeypatch.undo()
        whole = short_fit()
        np.testing.assert_array_equal(part.history["r"], whole.history["r"][:3])
        assert part.parameters["r"] == whole.history["r"][3]
        assert_same(short_fit(checkpoint=Checkpoint(path)), whole)

    def test_before_the_first_step_an_interruption_is_one(self, tmp_path, monkeypatch):
        def interrupted(*arguments):
            raise KeyboardInterrupt

        monkeypatch.setattr(mpfjax.tuning.optimisation, "scores", interrupted)
        with pytest.raises(KeyboardInterrupt):
            short_fit(checkpoint=Checkpoint(tmp_path / "fit.npz"))
        assert not (tmp_path / "fit.npz").exists()

    @pytest.mark.parametrize(
        ("other", "named"),
        [
            ({"num_seeds": 2}, "num_seeds is 4 there and 2 here"),
            ({"start": {"r": 0.7}}, r"filter\.model\.r is .* 0\.5 there and .* 0\.7 here"),
            ({"start": {"q": 0.7}}, r"filter\.model\.q is"),
            ({"start": {"num_particles": 8}}, r"filter\.num_particles is 16 there and 8 here"),
            ({"start": {"gradient": "none"}}, r"filter\._moves\[0\]\.gradient is"),
            ({"observations": OBSERVATIONS.at[3].add(1e-6)}, r"observations.* is"),
            ({"key": jax.random.key(1)}, "key is"),
            ({"transforms": {"r": Interval(0.0, 9.0)}}, r"transforms\['r'\]"),
            ({"parameters": {"r": lambda filter: filter.model.q}}, r"parameters\['r'\] is"),
            ({"optimizer": optax.sgd(0.05)}, "optimizer is"),
            ({"optimizer": optax.adam(0.06)}, "optimizer is"),
        ],
    )  # fmt: skip
    def test_a_checkpoint_of_another_fit_is_refused_with_what_differs(self, tmp_path, other, named):
        short_fit(1, checkpoint=Checkpoint(tmp_path / "fit.npz"))
        with pytest.raises(
            ValueError, match=r"checkpoint: .*fit\.npz is of another fit: .*" + named
        ):
            short_fit(checkpoint=Checkpoint(tmp_path / "fit.npz"), **other)

    def test_what_may_differ_is_how_long_it_goes_on(self, tmp_path):
        short_fit(2, checkpoint=Checkpoint(tmp_path / "fit.npz"))
        resumed = short_fit(checkpoint=Checkpoint(tmp_path / "fit.npz", every=1))
        assert_same(resumed, short_fit())

    @pytest.mark.parametrize(("num_steps", "step"), [(6, 0.2), (1, 1.0)])
    def test_a_fit_that_broke_does_not_go_on(self, tmp_path, num_steps, step):
        """In the middle, or where its end was evaluated."""
        options = {"optimizer": falling(step), "checkpoint": Checkpoint(tmp_path / "fit.npz")}
        with pytest.warns(UserWarning, match="was nan at step"):
            first = short_fit(num_steps, **options)
        before = (tmp_path / "fit.npz").read_bytes()
        for more in (0, 5):
            with pytest.warns(UserWarning, match="was nan at step"):
                assert_same(short_fit(num_steps + more, **options), first)
        assert (tmp_path / "fit.npz").read_bytes() == before

    @pytest.mark.parametrize(
        ("name", "array"),
        [
            ("['carry'][0]['r']", np.zeros((), np.float64)),
            ("['carry'][1][0].count", None),
            ("['rows'][0]", None),
        ],
    )
    def test_a_file_with_other_arrays_is_damaged(self, tmp_path, name, array):
        path = tmp_path / "fit.npz"
        short_fit(2, checkpoint=Checkpoint(path))
        arrays = load_arrays(path)
        del arrays[name]
        write_arrays(path, arrays | ({} if array is None else {name: array}))
        with pytest.raises(ValueError, match=r"checkpoint: .*fit\.npz: damaged"):
            short_fit(checkpoint=Checkpoint(path))

    def test_a_file_of_something_else_is_refused(self, tmp_path):
        path = tmp_path / "fit.npz"
        write_arrays(path, {"step": np.array(3)})
        with pytest.raises(ValueError, match=r"fit\.npz is no checkpoint of fit"):
            short_fit(checkpoint=Checkpoint(path))

    def test_an_optimiser_with_a_key_and_short_floats_goes_on(self, tmp_path):
        def disturb(updates, key, params=None):
            own, following = jax.random.split(key)
            noise = 0.01 * jax.random.normal(own)
            return jax.tree.map(lambda leaf: leaf + noise.astype(leaf.dtype), updates), following

        with_key = optax.GradientTransformation(lambda params: jax.random.key(3), disturb)
        noisy = optax.chain(with_key, optax.adam(0.05, mu_dtype=jnp.bfloat16))
        whole = short_fit(4, optimizer=noisy)
        options = {"optimizer": noisy, "checkpoint": Checkpoint(tmp_path / "fit.npz")}
        short_fit(2, **options)
        assert_same(short_fit(4, **options), whole)

    def test_a_checkpoint_that_is_cut_off_is_named_and_left_alone(self, tmp_path):
        path = tmp_path / "fit.npz"
        short_fit(1, checkpoint=Checkpoint(path))
        path.write_bytes(path.read_bytes()[:500])
        with pytest.raises(ValueError, match=r"fit\.npz: cut off"):
            short_fit(checkpoint=Checkpoint(path))
        assert path.stat().st_size == 500

    def test_a_full_disk_leaves_the_last_checkpoint(self, tmp_path):
        path = tmp_path / "fit.npz"
        short_fit(2, checkpoint=Checkpoint(path))
        before = path.read_bytes()
        with pytest.raises(OSError, match=r"fit\.npz"), no_room_beyond(500):
            short_fit(checkpoint=Checkpoint(path))
        assert path.read_bytes() == before

    @pytest.mark.parametrize("name", [None, "cosine"])
    def test_a_schedule_that_writes_into_its_closure_goes_on(self, tmp_path, name):
        """As optax's cosine does when it is first called, in this process and in a new one."""
        make = lambda: optax.adam(optax.cosine_decay_schedule(0.05, 10))  # noqa: E731
        options = {"checkpoint": Checkpoint(tmp_path / "fit.npz", name=name)}
        optimizer = make()
        short_fit(2, optimizer=optimizer, **options)
        short_fit(3, optimizer=optimizer, **options)
        assert_same(short_fit(4, optimizer=make(), **options), short_fit(4, optimizer=make()))

    def test_of_a_name_the_name_and_the_data_are_compared_alone(self, tmp_path):
        options = {"checkpoint": Checkpoint(tmp_path / "fit.npz", name="mine")}
        short_fit(1, **options)
        assert len(short_fit(2, optimizer=optax.adam(0.07), **options).history["r"]) == 2
        for other, named in (
            ({"checkpoint": Checkpoint(tmp_path / "fit.npz", name="yours")}, "name is mine there"),
            ({"start": {"r": 0.7}}, r"filter\.model\.r is"),
            ({"observations": OBSERVATIONS.at[3].add(1e-6)}, "observations.* is"),
        ):
            with pytest.raises(ValueError, match=named):
                short_fit(3, **options | other)


@pytest.mark.usefixtures("as_installed")
def test_bad_checkpoints_are_refused_by_name():
    for arguments, named in (
        ({"path": 3}, "path: 3"),
        ({"path": os.curdir}, "path: . is a directory"),
        ({"path": ""}, "path: ''"),
        ({"path": "a.npz", "every": 0}, "every: 0"),
        ({"path": "a.npz", "name": 3}, "name: 3"),
    ):
        with pytest.raises(ValueError, match=named):
            Checkpoint(**arguments)


def notes_of(path):
    with np.load(path, allow_pickle=False) as file:
        return json.loads(str(file["notes"]))


def assert_same(run, other):
    """To the bit, and neither has taken a step more."""
    assert run.parameters["r"] == other.parameters["r"]
    assert run.log_marginal_likelihood == other.log_marginal_likelihood
    assert run.stopped == other.stopped
    for name, values in other.history.items():
        np.testing.assert_array_equal(run.history[name], values)


class TestOptimisers:
    """Which are closures: two are the same where they take the same steps."""

    def program(self, optimizer):
        reals = {"r": jnp.ones(())}

        def first(reals):
            return optimizer.update(reals, optimizer.init(reals), reals)

        return program_of(first, reals)

    def same(self, one, other):
        with jax.numpy_dtype_promotion("standard"):
            return self.program(one) == self.program(other)

    @pytest.mark.parametrize(
        "make",
        [
            lambda: optax.adam(0.05),
            lambda: optax.adam(optax.cosine_decay_schedule(0.05, 100)),
            lambda: optax.chain(optax.clip(1.0), optax.inject_hyperparams(optax.sgd)(0.1)),
            lambda: optax.MultiSteps(optax.sgd(0.1), 3),
            lambda: falling(0.2),
            lambda: optax.sgd(lambda step: 0.1 / (1 + step)),
            lambda: optax.multi_transform({"a": optax.sgd(0.1), "b": optax.adam(0.2)}, {"r": "a"}),
            lambda: optax.chain(optax.add_noise(0.1, 0.5, 3), optax.scale_by_adam()),
        ],
    )
    def test_made_twice_they_are_the_same(self, make):
        assert self.same(make(), make())

    @pytest.mark.parametrize(
        ("one", "other"),
        [
            (optax.adam(0.05), optax.adam(0.06)),
            (optax.adam(0.05), optax.adamw(0.05)),
            (optax.adam(0.05, eps=1e-8), optax.adam(0.05, eps=1e-7)),
            (
                optax.adam(optax.cosine_decay_schedule(0.05, 100)),
                optax.adam(optax.cosine_decay_schedule(0.05, 200)),
            ),
            (
                optax.sgd(optax.piecewise_constant_schedule(0.1, {5000: 0.5})),
                optax.sgd(optax.piecewise_constant_schedule(0.1, {6000: 0.5})),
            ),
            (
                optax.inject_hyperparams(optax.sgd)(0.1),
                optax.inject_hyperparams(optax.sgd)(0.2),
            ),
            (optax.inject_hyperparams(optax.sgd)(0.1), optax.inject_hyperparams(optax.adam)(0.1)),
            (optax.MultiSteps(optax.sgd(0.1), 3), optax.MultiSteps(optax.sgd(0.1), 4)),
            (
                optax.sgd(functools.partial(jnp.multiply, 0.1)),
                optax.sgd(functools.partial(jnp.multiply, 0.2)),
            ),
        ],
    )
    def test_of_other_numbers_or_names_they_are_others(self, one, other):
        assert not self.same(one, other)

    @pytest.mark.thorough
    def test_they_are_the_same_in_another_process(self):
        """Where addresses and the order of sets are others."""
        code = """
import jax, jax.numpy as jnp, mpfjax, optax
from mpfjax.running.storage import describe, program_of
filter = mpfjax.mixture_particle_filter(mpfjax.QuadraticModel(0.3, 0.3, -2.5, 2.5), 20, 2)
optimizer = optax.chain(optax.clip(1.0), optax.adam(optax.cosine_decay_schedule(0.05, 100)))
reals = {"b": jnp.ones(()), "a": jnp.ones(3)}
run = lambda key: mpfjax.run_filter(key, filter, jnp.ones(3)).log_marginal_likelihood
print(program_of(optimizer.update, reals, optimizer.init(reals), reals))
print(describe((filter, {"a", "b"}.pop), values=True) and program_of(run, jax.random.key(0)))
"""
        digests = {
            subprocess.run(
                [sys.executable, "-c", code], env=os.environ | {"PYTHONHASHSEED": seed},
                capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2],
            ).stdout
            for seed in ("1", "2")
        }  # fmt: skip
        assert len(digests) == 1


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


def falling(step):
    """An optimiser that takes the same step down whatever the gradient is."""
    return optax.stateless(lambda updates, _: jax.tree.map(lambda u: 0 * u - step, updates))


@pytest.mark.thorough
def test_parameters_can_be_all_of_the_model():
    filter = mpfjax.particle_filter(ScalarLinear(), 16, gradient="stop")
    everything = fit(jax.random.key(0), filter, OBSERVATIONS, ADAM, 1, num_seeds=2, progress=False)
    assert everything.parameters.keys() == set("aqhrmp")


def test_the_bar_shows_the_steps(capsys):
    short_fit(2, progress=True)
    assert "2/2" in capsys.readouterr().err


class Plain(ScalarLinear):
    """Fields as a user writes them who knows nothing of arrays: floats, a count, a constant."""

    r: float = 0.5
    h: float = 1.0
    order: int = 3
    q: float = eqx.field(static=True, default=0.6)


class TestFloats:
    """Fields that are Python floats."""

    def fit(self, parameters, **numbers):
        filter = mpfjax.particle_filter(Plain(**numbers), 16, gradient="stop")
        return fit(
            jax.random.key(0), filter, OBSERVATIONS, ADAM, 3, parameters=parameters, num_seeds=4,
            progress=False,
        )  # fmt: skip

    def test_are_tuned_like_arrays_where_they_are_named(self):
        found = self.fit(NOISE)
        filter = mpfjax.particle_filter(ScalarLinear(), 16, gradient="stop")
        expected = fit(
            jax.random.key(0), filter, OBSERVATIONS, ADAM, 3, parameters=NOISE, num_seeds=4,
            progress=False,
        )  # fmt: skip
        np.testing.assert_allclose(found.history["r"], expected.history["r"], rtol=1e-5)
        assert len(set(found.history["r"])) == 3

    def test_that_are_static_are_said_to_be(self):
        with pytest.raises(ValueError, match=r"q picks 0\.6, which is .* static field.*asarray"):
            self.fit({"q": lambda filter: filter.model.q})

    def test_whole_numbers_are_no_parameters(self):
        with pytest.raises(ValueError, match=r"parameters: order is 3, no floating.*3\.0"):
            self.fit({"order": lambda filter: filter.model.order})

    def test_that_nobody_named_are_said_to_be_there(self):
        class Bare(eqx.Module):
            a: float = 0.5

        with pytest.raises(ValueError, match="nothing to tune; a are Python floats"):
            mpfjax.tuning.maximise(jax.random.key(0), lambda key, m: m.a, Bare(), ADAM, 1)


class TestBias:
    """A filter whose resampling has no gradient is tuned with a warning."""

    PROPOSAL = mpfjax.NetworkProposal.create(jax.random.key(0), 1, 1, 0.8)

    def fit(self, filter, parameters=NOISE):
        return fit(
            jax.random.key(0), filter, OBSERVATIONS, ADAM, 1, parameters=parameters, num_seeds=2,
            progress=False,
        )  # fmt: skip

    def test_the_default_is_warned_of(self):
        filter = mpfjax.particle_filter(ScalarLinear(), 16)
        with pytest.warns(UserWarning, match='fit: .* score of r is biased.*gradient="stop"'):
            self.fit(filter)

    @pytest.mark.filterwarnings("ignore:standard_errors. 2 seeds")
    def test_standard_errors_are_as_well(self):
        filter = mpfjax.particle_filter(ScalarLinear(), 16)
        with pytest.warns(UserWarning, match="standard_errors: .* score of r is biased"):
            standard_errors(
                jax.random.key(0), filter, OBSERVATIONS, parameters=NOISE, num_seeds=2
            )  # fmt: skip

    @pytest.mark.thorough
    def test_what_is_right_is_not(self):
        weights = {"w": lambda filter: filter.moves[1].proposal.network}
        learning = mpfjax.particle_filter(ScalarLinear(), 16, proposal=self.PROPOSAL)
        never = mpfjax.particle_filter(ScalarLinear(), 16, ess_threshold=0.0)
        propagation = mpfjax.Propagate(ScalarLinear())
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            self.fit(mpfjax.particle_filter(ScalarLinear(), 16, gradient="stop"))
            self.fit(learning, weights)
            self.fit(never)
            self.fit(mpfjax.Filter(propagation.model, [propagation], 16))

    def test_a_model_beside_its_proposal_is(self):
        learning = mpfjax.particle_filter(ScalarLinear(), 16, proposal=self.PROPOSAL)
        weights = {"w": lambda filter: filter.moves[1].proposal.network}
        with pytest.warns(UserWarning, match="score of r is biased"):
            self.fit(learning, weights | NOISE)


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"key": 0}, "key: 0 is no typed key"),
        ({"key": None}, "key: None is no typed key"),
        ({"key": [0, 1]}, "key: "),
        ({"key": jax.random.PRNGKey(0)}, "key: .*old kind"),
        ({"key": jax.random.split(jax.random.key(0), 2)}, "key: shape"),
        ({"filter": None}, "filter: None is not a filter"),
        ({"filter": ScalarLinear()}, "filter: "),
        ({"observations": None}, "observations: "),
        ({"observations": "12345678"}, "observations: '12345678' is no array"),
        ({"observations": 3.0}, "observations: "),
        ({"optimizer": 0.1}, "optimizer: 0.1 has no init"),
        ({"optimizer": optax.adam}, "optimizer: "),
        ({"num_steps": 2.0}, "num_steps: 2.0 is not a whole number of at least 1"),
        ({"num_seeds": "8"}, "num_seeds: '8'"),
        ({"curvature_seeds": 2.5}, "curvature_seeds: 2.5"),
        ({"checkpoint": "fit.npz"}, "checkpoint: 'fit.npz' is not a Checkpoint"),
        ({"parameters": {"all": True}}, "parameters: all"),
        ({"parameters": "r"}, "parameters: 'r' is no mapping"),
        ({"parameters": lambda f: f.model.r}, "parameters: .* is no mapping"),
        ({"parameters": {0: lambda f: f.model.r}}, "parameters: 0 is not a name"),
        ({"parameters": {"r": lambda f: f.model.rho}}, "parameters: r cannot be picked"),
        ({"parameters": {"r": lambda f: f.model.r * 2}}, "parameters: r cannot be picked"),
        ({"parameters": NOISE | {"s": NOISE["r"]}}, "parameters: r and s pick the same"),
        ({"transforms": {"r": Positive}}, r"transforms\['r'\]: .*write Positive\(\.\.\.\)"),
        ({"transforms": [Positive()]}, "transforms: "),
    ],
)
def test_wrong_types_are_refused_by_name(options, named):
    with pytest.raises(ValueError, match=named):
        short_fit(**options)


@pytest.mark.usefixtures("as_installed")
@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"key": 0}, "key: 0"),
        ({"filter": 1}, "filter: 1"),
        ({"num_seeds": 0}, "num_seeds: 0 is not a whole number of at least 1"),
        ({"num_seeds": 2.0}, "num_seeds: 2.0"),
        ({"parameters": 3}, "parameters: 3"),
        ({"transforms": 3}, "transforms: 3"),
    ],
)
def test_standard_errors_refuse_the_same(options, named):
    arguments = {"key": jax.random.key(0), "filter": small(), "observations": OBSERVATIONS}
    with pytest.raises(ValueError, match=named):
        standard_errors(**arguments | options)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"num_steps": 0}, "num_steps: 0"),
        ({"num_seeds": 0}, "num_seeds: 0"),
        ({"curvature_seeds": -1}, "curvature_seeds: -1"),
        ({"start": {"r": -0.5}}, r"parameters: r starts at -0.5, outside Positive"),
        ({"parameters": {"idle": lambda f: f.model.idle}, "transforms": {}}, "depend on idle"),
        ({"transforms": {"sigma": Positive()}}, r"transforms: \['sigma'\]"),
        ({"parameters": {}}, "parameters: there is nothing"),
        (
            {"parameters": {"n": lambda f: f.num_particles}, "transforms": {}},
            "parameters: n picks 16",
        ),
    ],
)
def test_bad_arguments_are_refused_by_name(options, named):
    with pytest.raises(ValueError, match=named):
        short_fit(**options)


def test_bad_sequences_are_refused():
    for observations in ([], [OBSERVATIONS, OBSERVATIONS.at[1].set(jnp.nan)]):
        with pytest.raises(ValueError, match="observations: "):
            fit(jax.random.key(0), small(), observations, ADAM, 1, parameters=NOISE)
