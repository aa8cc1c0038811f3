"""Which scores are strong is learned from what became of detections."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import isotonic_regression

from mpfjax.mixture import ParticleMixture
from mpfjax.vision.tracking import RankScores
from mpfjax.vision.tracking.detections import Detections
from mpfjax.vision.tracking.fates import Fates, rising
from mpfjax.vision.tracking.model import ObjectState
from mpfjax.vision.tracking.observation import TrackedFrame

CHAINS, ROOM = 8, 8


def found(rows):
    """Detections of square boxes (x, score), padded."""
    padded = np.ones((ROOM, 5))
    for number, (x, score) in enumerate(rows):
        padded[number] = [x, 50, 20, 20, score]
    boxes, scores = jnp.asarray(padded[:, :4]), jnp.asarray(padded[:, 4])
    return Detections(boxes, jnp.arange(ROOM) < len(rows), scores)


def judged(frames, lasting=100):
    """The chains and counts after these frames, whose scores are shares."""
    fates, after = Fates.none(CHAINS), jax.jit(Fates.after, static_argnums=3)
    for rows in frames:
        seen = found(rows)
        fates = after(fates, seen, seen.scores, lasting)
    return fates


def test_a_chain_is_judged_once_it_is_sure_or_gone():
    """One may be missing in one frame, not in two; a double is nobody."""
    frames = [
        [(0, 0.35), (100, 0.35), (200, 0.95), (203, 0.65)],  # 203 is a double of 200
        [(2, 0.45), (202, 0.25)],
        [(4, 0.95), (104, 0.55)],  # 100 went on, after a gap
        [(5, 0.15)],
        [],
    ]
    fates = judged(frames)
    kept = 0.995 ** np.arange(5)[::-1]
    good, bad = np.zeros(10), np.zeros(10)
    good[[9, 2, 1]] = kept[0] + kept[2], kept[1], kept[3]
    good[[3, 4]] = kept[2]  # of 0, judged when it got sure
    bad[[3, 5]] = kept[4]  # of 100
    np.testing.assert_allclose(fates.good, good, rtol=1e-6)
    np.testing.assert_allclose(fates.bad, bad, rtol=1e-6)
    np.testing.assert_array_equal(fates.pending, 0)


def test_a_chain_that_lasts_is_an_object_whatever_its_scores():
    """The frames count from its first detection; one that broke off begins anew."""
    here, there = (0, 0.25), (100, 0.45)
    frames = [[here, there]] * 4 + [[here]] * 2 + [[here, there]] * 5
    kept = 0.995 ** np.arange(11)[::-1]
    fates = judged(frames, lasting=6)
    good, bad = np.zeros(10), np.zeros(10)
    good[2] = 6 * kept[5] + np.sum(kept[6:])
    bad[4] = 4 * kept[5]
    np.testing.assert_allclose(fates.good, good, rtol=1e-6)
    np.testing.assert_allclose(fates.bad, bad, rtol=1e-6)
    fates = judged([*frames, [there]], lasting=6)
    np.testing.assert_allclose(fates.good[4], 6, rtol=1e-6)


def test_rising_is_isotonic_regression():
    rng = np.random.default_rng(0)
    for _ in range(20):
        values, weights = rng.normal(size=10), rng.uniform(0.1, 3, 10)
        expected = isotonic_regression(values, weights=weights).x
        result = rising(jnp.asarray(values, jnp.float32), jnp.asarray(weights, jnp.float32))
        np.testing.assert_allclose(result, expected, rtol=1e-4, atol=1e-5)


def recorded(highest, scale):
    """The strong score after 90 frames of three objects and of five false ones, over the scale.

    Objects score .2 to 1, the false up to the highest; both stay where they are.
    """
    rng = np.random.default_rng(3)
    mixture = ParticleMixture(
        particles=ObjectState.nowhere(CHAINS),
        log_weights=jnp.full(CHAINS, -jnp.inf),
        component_indicators=jnp.arange(CHAINS, dtype=jnp.int32),
        ancestor_indices=jnp.arange(CHAINS, dtype=jnp.int32),
        num_components=CHAINS,
        memory=RankScores().initial_memory(CHAINS),
    )
    for _ in range(90):
        rows = [(100 * k, rng.uniform(0.2, 1)) for k in range(3)]
        rows += [(100 * k, rng.uniform(0, highest)) for k in range(3, 8)]
        rows = [row for row in rows if rng.uniform() > 0.3]
        seen = found([(x, scale * score) for x, score in rows])
        mixture = STEP(mixture, TrackedFrame(seen, None))
    return float(mixture.memory["scores"].strong) / scale


STEP = jax.jit(lambda mixture, seen: RankScores()(jax.random.key(0), mixture, seen))


def test_what_is_strong_follows_from_what_became_of_such_scores():
    """What comes again and never scores more than .6 is none; beside it, .2 may be an object's."""
    assert recorded(0.6, 1.0) > 0.55
    assert recorded(0.1, 1.0) < 0.35


def test_scores_of_any_scale_are_ranked_alike():
    np.testing.assert_allclose(recorded(0.6, 64.0), recorded(0.6, 1.0), rtol=1e-5)
