"""Evidence has a standard error that covers, of one run and of several."""

import jax
import numpy as np
import pytest

import mpfjax
from mpfjax import Series
from mpfjax.tuning import compare_evidence, smc2
from tests.matrix.law import kalman
from tests.tuning.examples import INPUTS, LAW, OBSERVATIONS, A, Pushed, log_prior_of_a, sample_a


def test_of_several_runs_the_evidence_is_the_mean_of_their_estimates():
    rng = np.random.default_rng(0)
    # Lognormal estimates with the mean e^3 and e^1.
    runs = {
        name: m + 0.4 * rng.normal(size=2000) - 0.08 for name, m in {"b": 1.0, "a": 3.0}.items()
    }
    found = compare_evidence(runs)
    assert list(found.differences) == ["a", "b"]
    assert found.errors["a"] == pytest.approx(np.sqrt(np.exp(0.16) - 1) / np.sqrt(2000), rel=0.1)
    assert found.difference_errors["b"] == pytest.approx(np.hypot(*found.errors.values()))
    assert abs(found.differences["b"] - 2.0) < 4 * found.difference_errors["b"]
    assert found.probabilities["a"] == pytest.approx(1 / (1 + np.exp(-found.differences["b"])))
    assert repr(found).splitlines()[2].split()[0] == "a"
    shifted = compare_evidence({name: values - 1e4 for name, values in runs.items()})
    assert shifted.differences["b"] == pytest.approx(found.differences["b"], rel=1e-6)


def run_of(key, r=0.5, num_samples=600, num_steps=8):
    series = Series.skipping(OBSERVATIONS[:num_steps], INPUTS[:num_steps])
    return smc2(
        key, mpfjax.particle_filter(Pushed(r=r), 20), series, num_samples, sample_prior=sample_a,
        log_prior=log_prior_of_a, parameters=A, progress=False,
    )  # fmt: skip


def test_posteriors_of_different_data_and_runs_without_an_error_are_refused():
    one, other = run_of(jax.random.key(0)), run_of(jax.random.key(0), num_samples=30)
    assert np.isnan(other.log_marginal_likelihood_error)  # of five chains
    assert "without a standard error" in repr(other)
    with pytest.raises(ValueError, match="run of other has no standard error; use a larger"):
        compare_evidence({"one": one, "other": other})
    with pytest.raises(ValueError, match=r"of \[4, 8\] observations"):
        compare_evidence({"one": one, "short": run_of(jax.random.key(0), num_steps=4)})


def exact_log_evidence(r):
    """Of the mean likelihood over the prior of a, on a grid."""
    grid = np.linspace(-1.7, 2.3, 201)
    logs = [kalman(LAW._replace(a=a, r=r), OBSERVATIONS, INPUTS).log_z for a in grid]
    return np.logaddexp.reduce(logs + np.asarray(log_prior_of_a({"a": grid}))) + np.log(0.02)


@pytest.mark.exactness
def test_the_error_of_a_difference_covers_in_twenty_repetitions():
    """Two models, one run of each: χ² of the z-scores lies within chance, to 1 in 1000."""
    exact = {r: exact_log_evidence(r) for r in (0.5, 1.0)}
    z = []
    for keys in jax.random.split(jax.random.key(2), (20, 2)):
        runs = {f"{r}": run_of(key, r) for r, key in zip(exact, keys, strict=True)}
        found = compare_evidence(runs)
        (worse,) = (name for name, difference in found.differences.items() if difference > 0)
        (better,) = found.differences.keys() - {worse}
        error = found.differences[worse] - (exact[float(better)] - exact[float(worse)])
        z.append(error / found.difference_errors[worse])
    assert 5.4 < np.sum(np.square(z)) < 47.5, z
