"""Objects that come and go, against the enumeration of all associations and Gaussian sums."""

import itertools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import mpfjax
from mpfjax import ClutteredModel, Filter, TargetsModel
from mpfjax.moves.objects.association import associate
from mpfjax.moves.objects.bernoulli import TARGETS, Associate, _kth_smallest
from mpfjax.moves.propagation.propagate import Predict
from mpfjax.moves.resampling.gaussian import RegenerateObjects
from tests.assignments import enumerated
from tests.marking import weekly
from tests.models.test_clutter import OBJECT, SETS, Wide, by_associations
from tests.unbiased import assert_unbiased

KEY = jax.random.key(0)
A, Q, R, P0, P_D, CLUTTER, NAN = 0.9, 0.5, 0.3, 1.0, 0.7, 0.2, np.nan
SENSOR = ClutteredModel(OBJECT, P_D, CLUTTER)


def random_weights(seed, m, k):
    rng = np.random.default_rng(seed)
    return np.exp(rng.normal(0, 3, (m, k))), rng.uniform(0.02, 1, m), rng.uniform(0.1, 1, k)


ASSOCIATE = jax.jit(associate)


def by_propagation(pairs, missed, alone):
    """The same, of up to three rows and columns: one program, in which others have no pair."""
    m, k = pairs.shape
    wide = jnp.zeros((3, 3)).at[:m, :k].set(pairs.astype(np.float32))
    rows, columns = jnp.ones(3).at[:m].set(missed), jnp.ones(3).at[:k].set(alone)
    result = ASSOCIATE(wide, rows, columns)
    shares = wide * result.replies / result.row_sums[:, None]
    return np.asarray(shares)[:m, :k], float(result.log_total)


def test_associations_without_a_cycle_are_exact():
    for seed, (m, k) in enumerate([(1, 1), (1, 3), (3, 1), (2, 1), (1, 2)] * 3):
        weights = random_weights(seed, m, k)
        shares, log_total = enumerated(*weights)
        found, total = by_propagation(*weights)
        np.testing.assert_allclose(found, shares, atol=1e-5)
        np.testing.assert_allclose(total, log_total, atol=2e-5)


def test_two_certain_objects_share_a_measurement_evenly():
    """Weights so far apart that sums in float32 lose one of them."""
    found, total = by_propagation(np.full((2, 1), 1e8), np.full(2, 1e-12), np.ones(1))
    np.testing.assert_allclose(found, 0.5, atol=1e-4)
    np.testing.assert_allclose(total, np.log(2e-4), atol=1e-3)


def test_other_associations_are_near_the_exact_ones():
    gaps, totals = [], []
    for seed, (m, k) in enumerate([(2, 2), (3, 2), (2, 3), (3, 3)] * 15):
        weights = random_weights(seed, m, k)
        shares, log_total = enumerated(*weights)
        found, total = by_propagation(*weights)
        gaps.append(np.abs(found - shares).max())
        totals.append(total - log_total)
    assert np.mean(gaps) < 0.03
    assert np.max(gaps) < 0.41
    # Bethe's total is never more than the exact one.
    assert np.max(totals) < 1e-4
    assert np.mean(totals) > -0.1


def test_derivatives_of_associations():
    """That of the total is the probability of a pair; that of a probability by differences."""
    pairs, missed, alone = map(jnp.float32, random_weights(3, 3, 3))

    def total(log_pairs):
        return ASSOCIATE(jnp.exp(log_pairs), missed, alone).log_total

    found = by_propagation(*map(np.asarray, (pairs, missed, alone)))[0]
    np.testing.assert_allclose(jax.grad(total)(jnp.log(pairs)), found, atol=1e-3)

    def first(log_pair):
        changed = pairs.at[0, 0].set(jnp.exp(log_pair))
        result = ASSOCIATE(changed, missed, alone)
        return changed[0, 0] * result.replies[0, 0] / result.row_sums[0]

    at, step = jnp.log(pairs[0, 0]), 0.02
    slope = (first(at + step) - first(at - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(first)(at), slope, rtol=0.1, atol=2e-3)


@pytest.mark.parametrize(("n", "k"), [(40, 16), (3, 3), (16, 1)])
def test_the_kth_smallest_is_that_of_a_sort(n, k):
    """Also of equal numbers, of zeros and of the largest number."""
    rng = np.random.default_rng(0)
    values = np.exp(rng.normal(0, 8, (n, 5))).clip(max=1e6).astype(np.float32)
    values[rng.random(values.shape) < 0.2] = 0
    found = _kth_smallest(jnp.asarray(values), k)
    np.testing.assert_array_equal(found, np.sort(values, axis=0)[k - 1])


class Birth(mpfjax.AbstractBirth):
    """x_0 of the object; at a measurement, given it."""

    rate: jax.Array

    def sample(self, key, num_particles):
        return OBJECT.sample_initial(key, num_particles)

    def propose(self, key, measurement, num_particles, sensor=0):
        gain = P0 / (P0 + R)
        noise = jax.random.normal(key, (num_particles, 1))
        states = gain * measurement[None] + jnp.sqrt(gain * R) * noise
        predicted = jax.scipy.stats.norm.logpdf(measurement[0], 0.0, jnp.sqrt(P0 + R))
        return states, predicted - OBJECT.log_likelihood(measurement, states)


def model(rate=0.5, **options):
    options = {"survival_probability": 0.95, "initial_number": 0.0} | options
    return TargetsModel(SENSOR, Birth(jnp.float32(rate)), **options)


def associating(particles_per_birth=50, undetected_particles=400):
    return Associate(particles_per_birth, undetected_particles, mpfjax.Resample())


def bernoulli_mixture(filter, states, existence):
    """Objects of these particles, (m, n, 1), and no others, after as many empty slots."""
    m, n = states.shape[:2]
    mixture = filter.init(KEY)
    empty = mixture.num_particles - m * n
    weights = np.repeat(np.asarray(existence) / n / np.sum(existence), n)
    labels = np.arange(filter.num_components, dtype=np.int32)
    memory = mixture.memory[TARGETS] | {
        "number": jnp.float32(np.sum(existence)),
        "labels": jnp.where(labels <= m, labels, 0),
        "next_label": jnp.int32(m + 1),
    }
    log_weights = np.append(np.full(empty, -np.inf), np.log(weights))
    indicators = np.append(np.zeros(empty, int), np.repeat(np.arange(1, m + 1), n))
    return mixture.replace(
        particles=jnp.pad(jnp.asarray(states.reshape(-1, 1), jnp.float32), ((empty, 0), (0, 0))),
        log_weights=jnp.asarray(log_weights, jnp.float32),
        component_indicators=jnp.asarray(indicators, jnp.int32),
        memory=mixture.memory | {TARGETS: memory},
    )


def density(z, mean, variance):
    return scipy.stats.norm.pdf(z, mean, np.sqrt(variance))


@pytest.mark.exactness
@pytest.mark.parametrize("apart", [12.0, 1.0])
def test_one_scan_is_that_of_all_associations(apart):
    """Existence of old and new objects, their number, and the evidence."""
    n, existence, scan = 400, np.array([0.9, 0.6, 0.45]), np.array([0.3, apart, 2 * apart + 0.5])
    rng, targets = np.random.default_rng(0), model()
    states = rng.normal(0, 0.5, (3, n, 1)) + apart * np.arange(3)[:, None, None]
    filter = Filter(
        targets, [associating(particles_per_birth=400, undetected_particles=100)], 3 * n + 100, 8
    )
    mixture = bernoulli_mixture(filter, states, existence)
    padded = jnp.asarray(np.append(scan, NAN)[:, None], jnp.float32)
    moved, info = filter.step(KEY, mixture, padded)

    r, rate = 0.95 * existence, 0.5
    likelihoods = density(scan, states[..., 0][..., None], R).mean(axis=1) / CLUTTER
    pairs, missed = r[:, None] * P_D * likelihoods, 1 - r * P_D
    births = rate * P_D * density(scan, 0.0, P0 + R) / CLUTTER
    shares, log_total = enumerated(pairs, missed, 1 + births)
    of_none = 1 - shares.sum(axis=1)
    old = of_none * r * (1 - P_D) / missed + shares.sum(axis=1)
    new = (1 - shares.sum(axis=0)) * births / (1 + births)
    found = mpfjax.estimate_targets(moved)
    close = 1e-3 if apart > 10 else 0.12
    by_label = dict(zip(np.asarray(found.labels), np.asarray(found.existence), strict=True))
    np.testing.assert_allclose([by_label[k] for k in (1, 2, 3)], old, atol=close)
    started = np.sort([by_label[k] for k in by_label if k > 3])[::-1]
    np.testing.assert_allclose(started, np.sort(new[new > 1e-4])[::-1], atol=close)
    expected = old.sum() + new.sum() + rate * (1 - P_D)
    np.testing.assert_allclose(found.expected_number, expected, atol=close)
    log_evidence = log_total - rate * P_D
    np.testing.assert_allclose(info.log_likelihood_increment, log_evidence, atol=close)


@pytest.mark.exactness
def test_a_known_single_object_is_that_of_all_associations():
    """And E[x_t]."""
    sets, n = jnp.asarray(SETS, jnp.float32), 300
    moves = [Predict(), associating(undetected_particles=1)]
    filter = Filter(model(rate=1e-12, survival_probability=1.0), moves, n + 1, 3)
    single = bernoulli_mixture(filter, np.zeros((1, n, 1)), [1.0])

    def run(key):
        keys = jax.random.split(key, 1 + len(sets))
        mixture = single.replace(particles=jax.random.normal(keys[0], (n + 1, 1)))

        def step(mixture, data):
            mixture, info = filter.step(*data[:1], mixture, data[1])
            return mixture, info.log_likelihood_increment

        mixture, increments = jax.lax.scan(step, mixture, (keys[1:], sets))
        return jnp.sum(increments), mpfjax.estimate_targets(mixture).means[0, 0]

    totals, means = jax.jit(jax.vmap(run))(jax.random.split(KEY, 200))
    exact, mean = by_associations(SETS)
    ratios = np.exp(np.asarray(totals)) / exact
    assert_unbiased(ratios, loosest=0.02)
    assert_unbiased(ratios * np.asarray(means), mean, loosest=0.02)


def updated(gaussian, z):
    """A Gaussian (weight, mean, variance) after a measurement of its own; its weight is l / λ."""
    weight, mean, variance = gaussian
    gain = variance / (variance + R)
    weight = weight * P_D * density(z, mean, variance + R) / CLUTTER
    return weight, mean + gain * (z - mean), (1 - gain) * variance


def predicted(gaussian, survival):
    weight, mean, variance = gaussian
    return survival * weight, A * mean, A**2 * variance + Q


def gaussian_sums(number, rate, survival, first, second):
    """Two scans: r of each old and new object, how many are undetected, and the evidence."""
    born = (rate, 0.0, P0)
    unseen = [predicted((number, 0.0, P0), survival), born]
    log_evidence = -P_D * sum(w for w, *_ in unseen)
    objects = []
    for z in first:
        parts = [updated(g, z) for g in unseen]
        odds = sum(w for w, *_ in parts)
        log_evidence += np.log1p(odds)
        objects.append([(w / (1 + odds), m, v) for w, m, v in parts])
    unseen = [((1 - P_D) * w, m, v) for w, m, v in unseen]
    unseen = [*(predicted(g, survival) for g in unseen), born]
    log_evidence -= P_D * sum(w for w, *_ in unseen)
    objects = [[predicted(g, survival) for g in gaussians] for gaussians in objects]
    r = np.array([sum(w for w, *_ in gaussians) for gaussians in objects])
    pairs = [[sum(updated(g, z)[0] for g in each) for z in second] for each in objects]
    started = np.array([sum(updated(g, z)[0] for g in unseen) for z in second])
    shares, log_total = enumerated(np.array(pairs), 1 - P_D * r, 1 + started)
    old = (1 - shares.sum(axis=1)) * r * (1 - P_D) / (1 - P_D * r) + shares.sum(axis=1)
    new = (1 - shares.sum(axis=0)) * started / (1 + started)
    return old, new, (1 - P_D) * sum(w for w, *_ in unseen), log_evidence + log_total


@pytest.mark.exactness
@pytest.mark.parametrize("proposal", [None, *weekly([Wide()])])
@pytest.mark.parametrize(
    ("number", "first", "second"),
    [(2.0, [-2.5, 2.0], [2.2]), (0.0, [0.0, 0.7], [0.1, 0.6]), (0.0, [0.0, 0.7], [0.4])],
)
def test_two_scans_are_those_of_gaussian_sums(number, first, second, proposal):
    """From a Poisson number of objects; and of two that began in one scan, which are not one."""
    old, new, undetected, log_evidence = gaussian_sums(number, 0.5, 0.95, first, second)
    move = associating(500, 1000)
    filter = Filter(model(initial_number=number), [Predict(proposal), move], 3000, 7)
    scans = jnp.asarray([first, [*second, *[NAN] * (2 - len(second))]], jnp.float32)[..., None]
    runs = mpfjax.monte_carlo(
        jax.random.split(KEY, 20), filter, scans, collect=mpfjax.estimate_targets
    )
    last = jax.tree.map(lambda leaf: np.asarray(leaf)[:, -1], runs.collected)
    exact_number = old.sum() + new.sum() + undetected
    np.testing.assert_allclose(last.expected_number.mean(), exact_number, atol=0.04)
    np.testing.assert_allclose(last.undetected.mean(), undetected, atol=0.05)
    log_z = np.asarray(runs.log_marginal_likelihood)
    np.testing.assert_allclose(log_z.mean(), log_evidence, atol=0.04)
    if number > 0:  # no two compete; labels of the first scan are dealt by the most probable
        each = [np.where(last.labels == k, last.existence, 0).sum(1).mean() for k in (1, 2, 3)]
        np.testing.assert_allclose(np.sort(each[:2]), np.sort(old), atol=0.02)
        np.testing.assert_allclose(each[2], new, atol=0.02)


@pytest.mark.exactness
def test_sensors_in_turn_scans_without_measurements_and_missing_ones():
    """One object that may exist, against the product of the sensors' likelihoods."""
    near = ClutteredModel(OBJECT, lambda states: jnp.where(states[:, 0] < 1, 0.9, 0.0), CLUTTER)
    targets = TargetsModel((SENSOR, near), Birth(jnp.float32(1e-12)), 0.95)
    filter = Filter(targets, [associating(particles_per_birth=2, undetected_particles=10)], 110, 3)
    states = np.random.default_rng(0).normal(0.5, 1, (1, 100, 1))
    mixture, r = bernoulli_mixture(filter, states, [0.9]), 0.95 * 0.9
    for scan in ([[0.2], [NAN]], [[NAN], [NAN]]):
        scans = (jnp.asarray(scan), jnp.asarray(scan[::-1]))
        log_likelihood = targets.log_likelihood(scans, jnp.asarray(states[0], jnp.float32))
        likelihood = r * np.mean(np.exp(np.asarray(log_likelihood, float)))
        moved, info = filter.step(KEY, mixture, scans)
        total = 1 - r + likelihood
        np.testing.assert_allclose(info.log_likelihood_increment, np.log(total), atol=1e-4)
        found = mpfjax.estimate_targets(moved)
        assert found.labels.tolist() == [1, 0]
        np.testing.assert_allclose(found.existence, [likelihood / total, 0], atol=1e-4)
    moved, info = filter.predict(KEY, mixture)
    np.testing.assert_allclose(moved.memory[TARGETS]["number"], r, atol=1e-5)
    assert info.log_likelihood_increment == 0
    with pytest.raises(ValueError, match="observation: it is not a tuple"):
        filter.step(KEY, mixture, scans[0])


@pytest.mark.exactness
def test_two_components_of_one_object_become_one():
    """Where both may be true they stay, where they are apart, and where one is broad."""
    filter = Filter(model(1e-12), [associating(undetected_particles=10)], 210, 3)
    near = np.linspace(-1, 1, 100) + np.array([0.0, 0.8])[:, None]
    for gap, width, existence, expected in (
        (0.0, 1.0, [0.5, 0.4], [0.9, 0]),
        (0.0, 1.0, [0.7, 0.6], [0.7, 0.6]),
        (9.0, 1.0, [0.5, 0.4], [0.5, 0.4]),
        (0.0, 3.0, [0.5, 0.4], [0.5, 0.4]),
    ):
        states = near * np.array([[1.0], [width]]) + gap * np.arange(2)[:, None]
        moved = filter.predict(KEY, bernoulli_mixture(filter, states[..., None], existence))[0]
        found = mpfjax.estimate_targets(moved)
        np.testing.assert_allclose(found.existence, 0.95 * np.array(expected), atol=1e-3)
        assert found.labels.tolist() == [1, 2 if expected[1] else 0]
        assert found.number == 1  # the median


@pytest.mark.weekly
def test_derivatives_of_the_evidence():
    """By p_D, log λ and log R, over scans; against differences, in the mean over keys."""
    targets = model(0.3, initial_number=1.0)
    scans = jnp.array([[0.2, 1.5], [0.4, NAN], [0.1, -2.0], [NAN, NAN], [0.3, 2.0]])[..., None]
    keys = jax.random.split(KEY, 40)

    def log_evidence(at, key):
        p, log_clutter, log_noise = at
        moving = eqx.tree_at(lambda m: m.R, OBJECT, jnp.exp(log_noise)[None, None])
        sensor = ClutteredModel(moving, p, jnp.exp(log_clutter))
        changed = TargetsModel(sensor, targets.birth, 0.95, 1.0)
        filter = mpfjax.bernoulli_filter(changed, 800, 4)
        return mpfjax.run_filter(key, filter, scans).log_marginal_likelihood

    over_keys = jax.jit(jax.vmap(jax.value_and_grad(log_evidence), in_axes=(None, 0)))
    at, step = (jnp.float32(P_D), jnp.float32(-1.0), jnp.log(jnp.float32(R))), 0.1
    slopes = over_keys(at, keys)[1]
    for k, slope in enumerate(slopes):
        ends = [tuple(v + s * step * (j == k) for j, v in enumerate(at)) for s in (-1, 1)]
        values = [over_keys(end, keys)[0] for end in ends]
        differences = np.asarray(values[1] - values[0]) / (2 * step)
        error = np.hypot(np.std(slope), differences.std()) / np.sqrt(len(keys))
        assert error < 0.1
        assert abs(np.mean(slope) - differences.mean()) < 4 * error + 0.03


@pytest.mark.exactness
def test_objects_without_room_are_told_and_the_table_has_the_rest():
    sensor = ClutteredModel(OBJECT, 0.9, 1e-4)
    crowd = TargetsModel(sensor, Birth(jnp.float32(2.0)), 0.95)
    scans = jnp.tile(jnp.array([[-2.0], [0.0], [2.0]]), (3, 1, 1))
    run = mpfjax.run_filter(
        KEY, mpfjax.bernoulli_filter(crowd, 900, 2), scans, collect=mpfjax.estimate_targets
    )
    with pytest.warns(RuntimeWarning, match="there was no room at step 1"):
        table = mpfjax.track_table(run)
    assert set(table) == {"step", "label", "existence", "mean_0", "deviation_0"}
    assert len(table["step"]) == 6
    with pytest.raises(ValueError, match=r"run: it collected .*estimate_targets"):
        mpfjax.track_table(run.log_likelihood_increments)
    assert len(set(zip(table["step"], table["label"], strict=True))) == 6
    # The others still count.
    np.testing.assert_allclose(run.collected.expected_number[-1], 3, atol=0.7)
    with pytest.raises(ValueError, match="model: "):
        Filter(OBJECT, [Predict(), associating()], 1000, 3)
    with pytest.raises(ValueError, match="num_particles: 100 is less than 402"):
        Filter(crowd, [Predict(), associating()], 100, 3)


def test_the_number_is_that_of_independent_events():
    existence = np.array([0.9, 0.5, 0.0, 0.2])
    exact = np.zeros(5)
    for there in itertools.product([0, 1], repeat=4):
        exact[sum(there)] += np.prod(np.where(there, existence, 1 - existence))
    np.testing.assert_allclose(mpfjax.number_distribution(jnp.asarray(existence)), exact, atol=1e-6)


@pytest.mark.exactness
@pytest.mark.parametrize("region", [mpfjax.Box([-1, 0], [2, 1]), mpfjax.Disc([0.5, 0], 0.8)])
def test_new_objects_are_even_in_a_region(region):
    """The importance weights at a measurement integrate the same density as draws anywhere."""

    def locate(key, z, n):
        offsets = 0.3 * jax.random.normal(key, (n, 2))
        return z[None] + offsets, jnp.sum(jax.scipy.stats.norm.logpdf(offsets, scale=0.3), 1)

    birth = mpfjax.UniformBirth(1.0, region, lambda key, places: places, locate)
    states = birth.sample(KEY, 20_000)
    z = jnp.array([0.4, 0.5])

    def near(places):
        return jnp.exp(-jnp.sum((places - z[None]) ** 2, 1) / 0.18)

    proposed, log_weights = birth.propose(KEY, z, 20_000, 0)
    expected = np.asarray(near(states))
    found = np.asarray(near(proposed) * jnp.exp(log_weights))
    error = np.hypot(expected.std(), found.std()) / np.sqrt(20_000)
    assert abs(expected.mean() - found.mean()) < 4 * error < 0.03


def test_first_existences_are_those_of_a_grid():
    """Objects anywhere in 1000 m, seen with an error of 1 m and a p_D that changes at 0.

    After four empty scans there are far more where they are seldom detected.
    """
    rate, number, survival, half = 0.1, 3.0, 0.98, 500.0
    walk = mpfjax.LinearGaussianModel([[1.0]], [[0.25]], [[1.0]], [[1.0]], [0.0], [[1.0]])

    def locate(key, z, n):
        noise = jax.random.normal(key, (n, 1))
        return z[None] + noise, jax.scipy.stats.norm.logpdf(noise[:, 0])

    def detection(states):
        return jnp.where(states[:, 0] < 0, 0.8, 0.1)

    region = mpfjax.Box([-half], [half])
    birth = mpfjax.UniformBirth(rate, region, lambda key, places: places, locate)
    sensor, clutter = ClutteredModel(walk, detection, 0.02), 0.02
    targets = TargetsModel(sensor, birth, survival, number)
    scan = np.linspace(-450, 450, 10)
    scans = jnp.full((5, 10, 1), jnp.nan).at[4, :, 0].set(scan)

    x = np.arange(-520, 520, 0.1)
    kernel = density(np.arange(-30, 31) * 0.1, 0.0, 0.25) * 0.1
    born = np.where(np.abs(x) <= half, rate / (2 * half), 0.0)
    u, p = number * born / rate, np.where(x < 0, 0.8, 0.1)
    for t in range(5):
        u = np.convolve(survival * u, kernel, mode="same") + born
        if t < 4:
            u *= 1 - p
    odds = (p * u * density(scan[:, None], x, 1.0)).sum(axis=1) * 0.1 / clutter
    exact = odds / (1 + odds)

    filter = mpfjax.bernoulli_filter(targets, 1000, 12)
    runs = mpfjax.monte_carlo(
        jax.random.split(KEY, 8), filter, scans, collect=mpfjax.estimate_targets
    )
    existence, means = (np.asarray(leaf)[:, -1] for leaf in runs.collected[1:3])
    nearest = np.abs(means[..., 0] - scan[:, None, None]).argsort(axis=2)[..., 0]
    found = np.take_along_axis(existence, nearest.T, axis=1)
    ratios = found / exact
    assert 0.8 < np.median(ratios) < 1.25
    assert np.mean(np.abs(np.log(ratios)) < np.log(1.25)) > 0.9


@pytest.mark.exactness
@pytest.mark.parametrize("num_sensors", [1, 2])
def test_detection_that_is_certain_or_never_happens(num_sensors):
    """Empty scans, their evidence and its derivative by p_D, and scans with measurements."""
    empty = jnp.full((3, 2, 1), jnp.nan)
    seen = empty.at[0].set(jnp.array([[0.3], [1.0]])).at[2, 0].set(0.2)

    def log_evidence(p, number, scans):
        targets = TargetsModel(
            (ClutteredModel(OBJECT, p, CLUTTER),) * num_sensors,
            Birth(jnp.float32(0.5)),
            0.95,
            number,
        )
        filter = mpfjax.bernoulli_filter(targets, 800, 4)
        scans = scans if num_sensors == 1 else (scans, scans[:, ::-1])
        run = mpfjax.run_filter(KEY, filter, scans, collect=mpfjax.estimate_targets)
        return run.log_marginal_likelihood, run.collected.expected_number

    def exact(p, number):
        total = 0.0
        for _ in range(3):
            number = 0.95 * number + 0.5
            total, number = (
                total - number * (1 - (1 - p) ** num_sensors),
                number * (1 - p) ** num_sensors,
            )
        return total

    p, number = jnp.array([0.0, 0.0, 1.0, 1.0]), jnp.array([0.0, 2.0, 0.0, 2.0])
    both = jax.vmap(jax.value_and_grad(log_evidence, has_aux=True), in_axes=(0, 0, None))
    both = jax.jit(both)
    (values, numbers), slopes = both(p, number, empty)
    expected, expected_slopes = jax.vmap(jax.value_and_grad(exact))(p, number)
    np.testing.assert_allclose(values, expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(slopes[:2], expected_slopes[:2], rtol=0.01, atol=1e-4)
    # At p_D = 1 no particle is left of those missed, so that later scans do not count: finite.
    assert np.isfinite(slopes).all()
    np.testing.assert_allclose(numbers[2:], 0.0, atol=1e-6)
    (values, numbers), slopes = both(p, number, seen)
    assert np.isfinite(values).all()
    assert np.isfinite(slopes).all()
    np.testing.assert_allclose(values[:2], 0.0, atol=1e-5)


class Inputs(eqx.Module):
    """Whatever is made of u_t at a step."""

    function: Callable = eqx.field(static=True)
    inputs: Any = None

    def __call__(self, values):
        return self.function(self.inputs, values)


class WithoutInputs(mpfjax.AbstractStateSpaceModel):
    """The object, with nothing that depends on u_t."""

    sample_initial, sample_transition = OBJECT.sample_initial, OBJECT.sample_transition
    log_likelihood = OBJECT.log_likelihood


class BirthInTime(mpfjax.AbstractBirth):
    """The rate is that of u_t."""

    inputs: Any = None

    @property
    def rate(self):
        return self.inputs["rate"]

    def sample(self, key, num_particles):
        return Birth(0.0).sample(key, num_particles)

    def propose(self, *arguments):
        return Birth(0.0).propose(*arguments)


@pytest.mark.exactness
def test_inputs_reach_survival_births_detection_and_clutter():
    """As numbers do that are the same; a sensor that is off has a p_D of 0."""
    p, clutter, survival, rate = 0.8, 0.3, 0.6, 1.5
    in_time = TargetsModel(
        ClutteredModel(
            WithoutInputs(),
            Inputs(lambda u, states: jnp.full(len(states), u["p"])),
            Inputs(lambda u, measurement: u["clutter"]),
        ),
        BirthInTime(),
        Inputs(lambda u, states: jnp.full(len(states), u["survival"])),
        2.0,
    )
    numbers = {"p": p, "clutter": clutter, "survival": survival, "rate": rate}
    inputs = {name: jnp.full(3, value) for name, value in numbers.items()}
    inputs["p"] = inputs["p"].at[1].set(0.0)
    scans = jnp.array([[[0.3], [1.0]], [[NAN], [NAN]], [[0.2], [NAN]]])
    series = mpfjax.Series(scans, inputs)
    filter = mpfjax.bernoulli_filter(in_time, 600, 4)
    run = mpfjax.run_filter(KEY, filter, series, collect=mpfjax.estimate_targets)
    fixed = TargetsModel(
        ClutteredModel(WithoutInputs(), p, clutter), Birth(jnp.float32(rate)), survival, 2.0
    )
    filter = mpfjax.bernoulli_filter(fixed, 600, 4)
    same = mpfjax.run_filter(KEY, filter, scans[:1], collect=mpfjax.estimate_targets)
    np.testing.assert_allclose(
        run.log_likelihood_increments[0], same.log_likelihood_increments[0], rtol=1e-5
    )
    np.testing.assert_allclose(run.log_likelihood_increments[1], 0.0, atol=1e-5)
    numbers = run.collected.expected_number
    np.testing.assert_allclose(numbers[0], same.collected.expected_number[0], rtol=1e-5)
    np.testing.assert_allclose(numbers[1], survival * numbers[0] + rate, rtol=1e-4)
    with pytest.raises(ValueError, match="inputs: TargetsModel has neither"):
        mpfjax.run_filter(KEY, filter, series)


@pytest.mark.exactness
def test_regenerated_objects_have_the_covariance_of_their_weights_and_more_slots_where_they_exist():
    """Over samples of ten, the variance is the population's; the paper's estimate is less."""
    n, rng = 10, np.random.default_rng(0)
    filter = Filter(model(), [Predict(), associating(undetected_particles=1)], 101, 3)
    states = rng.normal(0, 2, (400, 2, n, 1))
    mixture = bernoulli_mixture(filter, states[0], [0.999, 0.001])

    def redrawn(key, states):
        particles = mixture.particles.at[-2 * n :].set(states.reshape(-1, 1).astype(jnp.float32))
        return RegenerateObjects().resample(key, mixture.replace(particles=particles))

    moved = jax.jit(jax.vmap(redrawn))(jax.random.split(KEY, 400), states)
    indicators, draws = np.asarray(moved.component_indicators[0]), np.asarray(moved.particles)
    counts = np.bincount(indicators, minlength=3)
    np.testing.assert_allclose(counts[1] / counts[2], 999**0.25, rtol=0.1)
    assert_unbiased(draws[:, indicators == 1, 0].var(axis=1, ddof=1), 4.0)
