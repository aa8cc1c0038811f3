"""Whether what appears beside an object is another one is learned from what became of the others.

The counts stand against those of a plain loop over a random history of lives, the assignment
against SciPy's in two rounds, and the tracker against the truth of two rendered recordings: of
people who walk in pairs, and of a detector that gives two boxes for one person.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from mpfjax.metrics import multi_object_scores
from mpfjax.mixture import ParticleMixture
from mpfjax.vision import track
from mpfjax.vision.tracking import LearnDoubles
from mpfjax.vision.tracking.assignment import Assign
from mpfjax.vision.tracking.detections import Detections
from mpfjax.vision.tracking.memory import ASSIGNED, DOUBLES, LIVES, SCORES, Lives, Scores
from mpfjax.vision.tracking.model import DetectedObjectModel, Gaussian, ObjectState
from mpfjax.vision.tracking.observation import TrackedFrame
from mpfjax.vision.tracking.track import online_rows
from mpfjax.vision.tracking.tracker import ObjectTracker

M, SIDE = 5, 20.0
NOTHING = TrackedFrame(Detections(jnp.ones((1, 4)), jnp.zeros(1, bool), jnp.zeros(1)), None)


def mixture_at(x, identities, detected, doubles):
    """Components of one particle each, squares in a row with their centres at x."""
    place = jnp.stack([x, 0 * x, 0 * x + np.log(SIDE), 0 * x + np.log(SIDE)], axis=1)
    zero = jnp.zeros_like(place)
    labels = jnp.arange(M, dtype=jnp.int32)
    return ParticleMixture(
        particles=ObjectState.of(Gaussian(place, zero, zero + 1.0, zero, zero + 1.0), labels),
        log_weights=jnp.full(M, -jnp.log(1.0 * M)),
        component_indicators=labels,
        ancestor_indices=labels,
        num_components=M,
        memory={
            LIVES: Lives.none(M)._replace(identities=identities, shown=identities > 0),
            ASSIGNED: jnp.where(detected, labels, -1),
            DOUBLES: doubles,
        },
    )


def common_share(gap):
    """Intersection over union of two squares whose centres are this far apart."""
    width = max(SIDE - abs(gap), 0.0)
    return width / (2 * SIDE - width)


def test_what_becomes_of_those_beside_an_object_is_counted_once():
    """Against a dictionary of hosts, with squares that wander, appear and end at random."""
    random = np.random.default_rng(1)
    move = jax.jit(LearnDoubles().__call__)
    doubles = LearnDoubles().initial_memory(M)[DOUBLES]
    places, names, last = np.zeros(M), np.zeros(M, int), 0
    hosts, objects, number = {}, 0.0, 0.0
    decided = [0, 0]
    for _ in range(400):
        places = places + random.normal(0, 2, M)
        before = {name for name in names if name}
        names = np.where(random.random(M) < 0.05, 0, names)
        for slot in np.flatnonzero((names == 0) & (random.random(M) < 0.3)):
            last += 1
            names[slot], places[slot] = last, random.uniform(0, 60)
        detected = random.random(M) < 0.8
        slots = {name: slot for slot, name in enumerate(names) if name}
        objects, number = 0.995 * objects, 0.995 * number
        for name, host in list(hosts.items()):
            if host not in slots:
                del hosts[name]
            elif name not in slots:
                del hosts[name]
                number += 1
                decided[1] += 1
            else:
                a, b = slots[name], slots[host]
                if common_share(places[a] - places[b]) < 0.15 and detected[a] and detected[b]:
                    del hosts[name]
                    objects += 1
                    decided[0] += 1
        for name in set(slots) - before:
            shares = {
                older: common_share(places[slots[name]] - places[slots[older]])
                for older in slots
                if older < name
            }
            if shares and max(shares.values()) > 0.15:
                hosts[name] = max(shares, key=lambda older: shares[older])
        mixture = mixture_at(
            jnp.asarray(places, jnp.float32),
            jnp.asarray(names, jnp.int32),
            jnp.asarray(detected),
            doubles,
        )
        memory = move(jax.random.key(0), mixture, NOTHING).memory
        doubles = memory[DOUBLES]
        np.testing.assert_array_equal(doubles.hosts, [hosts.get(name, 0) for name in names])
        np.testing.assert_allclose([doubles.objects, doubles.doubles], [objects, number], rtol=1e-4)
        probable = (objects + 2.5) / (objects + number + 5) >= 1 / 3
        expected = [name in hosts and not probable for name in names]
        np.testing.assert_array_equal(doubles.doubtful, expected)
        np.testing.assert_array_equal(memory[LIVES].shown, (names > 0) & ~np.array(expected))
    assert min(decided) > 5


def test_who_is_more_probably_a_double_has_what_the_others_leave():
    """Pairs are SciPy's for all others alone, then for doubles and the detections that are left."""
    random = np.random.default_rng(2)
    move = Assign(DetectedObjectModel(), gate=5.0)
    assign = jax.jit(
        lambda mixture, frame: move(jax.random.key(0), mixture, frame).memory[ASSIGNED]
    )
    costs = jax.jit(lambda mixture, frame: move.costs(mixture, frame))
    zero, changed = jnp.zeros(()), 0
    for _ in range(30):
        doubtful = random.random(M) < 0.5
        places = jnp.asarray(random.uniform(0, 40, M), jnp.float32)
        names = jnp.arange(1, M + 1, dtype=jnp.int32)
        found = np.stack([random.uniform(0, 40, 6), 0 * np.ones(6), *np.full((2, 6), SIDE)], axis=1)
        boxes = jnp.asarray(found, jnp.float32)
        frame = TrackedFrame(Detections(boxes, jnp.ones(6, bool), jnp.ones(6)), None)

        def mixture(yielding, places=places, names=names):
            doubles = LearnDoubles().initial_memory(M)[DOUBLES]._replace(doubtful=yielding)
            mixture = mixture_at(places, names, names > 0, doubles)
            scores = Scores(jnp.ones(4), jnp.zeros((), jnp.int32), zero, zero)
            return mixture.replace(memory=mixture.memory | {SCORES: scores})

        cost = np.asarray(costs(mixture(jnp.zeros(M, bool)), frame), float)
        expected, left = np.full(M, -1), np.ones(6, bool)
        for group in (~doubtful, doubtful):
            rows, columns = np.flatnonzero(group), np.flatnonzero(left)
            alone = np.full((len(rows), len(rows)), 5.0)
            table = np.minimum(cost[np.ix_(rows, columns)], 1e4)
            for row, column in zip(*linear_sum_assignment(np.c_[table, alone]), strict=True):
                if column < len(columns):
                    expected[rows[row]], left[columns[column]] = columns[column], False
        np.testing.assert_array_equal(assign(mixture(jnp.asarray(doubtful)), frame), expected)
        changed += (expected != np.asarray(assign(mixture(jnp.zeros(M, bool)), frame))).any()
    assert changed > 5


def recording(doubled):
    """People who cross the picture: in pairs, or single ones whom the detector splits now and then.

    The partner walks half a width beside the first, and from half the way on away from her. A split
    person has two boxes for some seven frames out of forty, at either side of the true one and
    with scores of their own: often enough the double has ended before the next one, which is what
    is learned from. The detector's errors are 3% of a box.
    """
    random = np.random.default_rng(3)
    truth, found = [], []

    def detect(frame, x, y, score):
        errors = random.normal(0, 0.03, 4) * [30, 80, 30, 80]
        found.append([frame, -1, *(np.array([x, y, 30, 80]) + errors), score])

    for person in range(24):
        second = person % 2 and not doubled
        start = 1 + (9 * person if doubled else 18 * (person // 2))
        row = person % 4 if doubled else (person // 2) % 4
        split = 0
        for t in range(120):
            apart = 13 + 0.8 * max(t - 60, 0) if second else 0.0
            x, y = 20 + 4 * t + apart, 60 + 130 * row
            truth.append([start + t, person + 1, x, y, 30, 80])
            split = max(split - 1, 0) if random.random() > 0.03 else 7
            if doubled and split:
                detect(start + t, x - 6, y + 4, random.uniform(0.6, 1))
                detect(start + t, x + 6, y - 4, random.uniform(0.6, 1))
            else:
                detect(start + t, x, y, 1.0)
    return np.asarray(truth, float), np.asarray(found, float)


def scores(doubled, learns):
    truth, found = recording(doubled)
    tracker = ObjectTracker(32)
    moves = [move for move in tracker.moves if learns or not isinstance(move, LearnDoubles)]
    tracks = track(None, found, ObjectTracker(32, moves=moves), frame_size=(600, 700))
    rows = [online_rows(number, shown) for number, shown in enumerate(tracks, 1)]
    last = int(truth[:, 0].max())
    return multi_object_scores(np.concatenate(rows), truth, (1, last))


def test_doubles_take_fewer_names_where_the_detector_splits_people():
    with_it, without = scores(doubled=True, learns=True), scores(doubled=True, learns=False)
    assert with_it["id_switches"] < 0.7 * without["id_switches"]
    assert with_it["IDF1"] > without["IDF1"] + 0.1
    assert with_it["HOTA"] > without["HOTA"] + 0.1


def test_people_who_walk_in_pairs_are_tracked_as_without_it():
    with_it, without = scores(doubled=False, learns=True), scores(doubled=False, learns=False)
    assert with_it["IDF1"] > 0.98
    assert with_it["id_switches"] == without["id_switches"] == 0
    assert with_it["HOTA"] >= without["HOTA"] - 1e-6


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"beside": 1.5}, "beside: 1.5"),
        ({"least": 2}, "least: 2"),
    ],
)
def test_bad_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        LearnDoubles(**settings)
