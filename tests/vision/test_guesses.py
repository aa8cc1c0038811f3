"""For how long an object without a detection is shown is learned from earlier guesses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import isotonic_regression

from mpfjax.mixture import ParticleMixture
from mpfjax.vision import track
from mpfjax.vision.tracking import Deaths, LearnGuesses
from mpfjax.vision.tracking.detections import Detections
from mpfjax.vision.tracking.memory import ASSIGNED, GUESSES, LIVES, Lives
from mpfjax.vision.tracking.model import Gaussian, ObjectState
from mpfjax.vision.tracking.observation import TrackedFrame
from mpfjax.vision.tracking.tracker import object_model

M, PATIENCE = 3, 40  # two frames in each bin
MODEL = object_model(25.0)
DEATHS = Deaths(patience=PATIENCE, longest_guess=4)


def still():
    """Three objects that stand still, one component each, with 20 pixels to a side."""
    place = jnp.asarray([[x, 50.0, np.log(20.0), np.log(20.0)] for x in (50.0, 150.0, 250.0)])
    one = jnp.ones_like(place)
    moments = Gaussian(place, 0 * one, 1e-4 * one, 0 * one, 1e-6 * one)
    lives = Lives.none(M)
    lives = lives._replace(identities=jnp.array([1, 2, 3]), confirmed=jnp.ones(M, bool))
    return ParticleMixture(
        particles=ObjectState.of(moments, jnp.arange(M, dtype=jnp.int32)),
        log_weights=jnp.full(M, -jnp.log(3.0)),
        component_indicators=jnp.arange(M, dtype=jnp.int32),
        ancestor_indices=jnp.arange(M, dtype=jnp.int32),
        num_components=M,
        memory={
            LIVES: lives,
            ASSIGNED: jnp.full(M, -1, jnp.int32),
            **LearnGuesses(MODEL, DEATHS).initial_memory(M),
        },
    )


def test_guesses_are_counted_when_they_are_decided():
    """Against a count of single frames: one comes back, one comes back elsewhere, one ends."""
    move = jax.jit(LearnGuesses(MODEL, DEATHS).__call__)
    mixture = still()
    boxes = jnp.asarray([[51.0, 50, 20, 20], [165, 50, 20, 20], [250, 50, 20, 20]])
    frame = TrackedFrame(Detections(boxes, jnp.ones(M, bool), jnp.ones(M)), None)
    borne_out = [True, False, None]
    detected = np.array([[0, 0, 0]] * 3 + [[0, 1, 0]] * 4 + [[1, 0, 0], [0, 1, 0]]).astype(bool)
    alive = np.array([[1, 1, 1]] * 6 + [[1, 1, 0]] * 3).astype(bool)
    unseen, right, wrong = np.zeros(M, int), np.zeros(PATIENCE), np.zeros(PATIENCE)
    for here, living in zip(detected, alive, strict=True):
        lives = mixture.memory[LIVES]._replace(
            identities=jnp.where(living, jnp.arange(1, M + 1), 0),
            confirmed=jnp.asarray(living),
            unseen=jnp.asarray(unseen, jnp.int32),
        )
        source = jnp.where(here, jnp.arange(M), -1).astype(jnp.int32)
        memory = mixture.memory | {LIVES: lives, ASSIGNED: source}
        mixture = move(jax.random.key(0), mixture.replace(memory=memory), frame)
        right, wrong = 0.995 * right, 0.995 * wrong
        for number in range(M):
            if here[number] or not living[number]:
                (right if here[number] and borne_out[number] else wrong)[: unseen[number]] += 1
        unseen = np.where(here | ~living, 0, unseen + 1)
    guesses = mixture.memory[GUESSES]
    assert right.sum() > 5
    np.testing.assert_allclose(guesses.right, right.reshape(20, 2).sum(1), rtol=1e-5)
    np.testing.assert_allclose(guesses.wrong, wrong.reshape(20, 2).sum(1), rtol=1e-5)
    # The longest guess is where isotonic regression, by scipy, falls below a half.
    number = guesses.right + guesses.wrong + 5
    prior = 1 / (1 + np.exp((np.arange(1.5, 40, 2) - 4.5) / 2.25))
    falling = isotonic_regression(
        np.asarray((guesses.right + 5 * prior) / number), weights=number, increasing=False
    )
    assert int(guesses.longest) == 2 * np.sum(falling.x >= 0.5)


@pytest.mark.parametrize("come_back", [True, False])
def test_objects_that_come_back_are_shown_for_longer_than_objects_that_do_not(come_back):
    """Two objects a second come in; each is missed from its 25th to its 36th frame, and leaves.

    Without a strong detection an object is shown for .3 seconds at most, 8 frames.
    """
    rows = []
    for number in range(20):
        for t in range(57 if come_back else 24):
            if not 24 <= t < 36:
                x, y = 302 + 5 * t, 20 + 80 * (number % 6)
                rows.append([1 + 12 * number + t, -1, x, y, 30, 60, 1])
    guessed = [
        np.sum(tracks.shown & (tracks.detections < 0))
        for tracks in track(None, np.asarray(rows, float), frame_size=(600, 600))
    ]
    assert np.sum(guessed[24:36]) == 2  # of the first object: nothing is learned yet
    late = np.sum(guessed[156:252])
    assert late > 3 * 16 if come_back else late == 0  # 16 if nothing were learned
