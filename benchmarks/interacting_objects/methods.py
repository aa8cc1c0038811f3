"""The filters that are compared, and one run of each in every scene."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import mpfjax
from benchmarks.interacting_objects.model import BOX, SHARPNESS, Blob, place_of
from benchmarks.interacting_objects.partitions import adaptive_partitions, independent_partitions
from benchmarks.interacting_objects.scenes import NUM_FRAMES, Scene, Setting
from mpfjax.metrics.tracking_quality import track_state

REPULSION = 2 * SHARPNESS  # so that sharing a place never pays; none from a box's side on
RUNS_AT_ONCE = 20


def dps(reassembly: str) -> Callable[..., mpfjax.Filter]:
    return lambda model, n: mpfjax.distributed_partitioned_sampling(model, n, None, reassembly)


def crossing(model: mpfjax.MultiObjectModel, num_particles: int) -> mpfjax.Filter:
    """Shared-proposal crossing of all objects in one cluster."""
    return mpfjax.clustered_particle_filter(model, num_particles, start="together")


def splitting(model: mpfjax.MultiObjectModel, num_particles: int) -> mpfjax.Filter:
    """Clusters that part after five steps without contact, an approximation."""
    return mpfjax.clustered_particle_filter(model, num_particles, split_after=5)


def adaptive_with_draws(model: mpfjax.MultiObjectModel, num_particles: int) -> mpfjax.Filter:
    """Adaptive partitions with five points in each row, so up to five times the likelihoods."""
    return adaptive_partitions(model, num_particles, num_draws=5)


METHODS: dict[str, tuple[str, Callable[..., mpfjax.Filter]]] = {
    "joint": ("joint PF", mpfjax.particle_filter),
    "ps": ("PS", mpfjax.partitioned_sampling),
    "dps_prior": ("DPS, prior", dps("prior")),
    "dps_evidence": ("DPS, evidence", dps("evidence")),
    "independent": ("independent", mpfjax.independent_particle_filters),
    "independent_partitions": ("independent partitions", independent_partitions),
    "adaptive": ("adaptive partitions", adaptive_partitions),
    "adaptive_draws": ("adaptive partitions, K = 5", adaptive_with_draws),
    "crossing": ("one cluster", crossing),
    "clusters": ("clusters", mpfjax.clustered_particle_filter),
    "splitting": ("clusters that split", splitting),
}
ONE_BY_ONE = ("crossing", "clusters", "splitting")
ESTIMATES = ("median", "mean")


@eqx.filter_jit
def run_all(
    make: Callable[..., mpfjax.Filter],
    num_particles: int,
    keys: Key[Array, " runs"],
    scenes: Scene,
    orders: Array | None,
    runs_at_once: int | None,
) -> dict[str, Float[Array, "runs t objects 2"]]:
    """The estimates of one run of the filter in each scene."""

    def run(inputs: tuple) -> dict[str, Float[Array, "t objects 2"]]:
        key, scene, order = inputs
        num_objects = scene.places.shape[1]
        blobs = Blob(scene.places[0], 2 * scene.places[0] - scene.places[1])
        repulsion = mpfjax.PairwiseRepulsion(REPULSION, BOX, place_of)
        model = mpfjax.MultiObjectModel(blobs, num_objects, repulsion, per_object=True)
        filter = make(model, num_particles) if order is None else make(model, num_particles, order)
        seen = jax.tree.map(lambda leaf: leaf[1:], scene.seen)
        return mpfjax.run_filter(key, filter, seen, estimates).collected

    return jax.lax.map(run, (keys, scenes, orders), batch_size=runs_at_once)


def estimates(mixture: mpfjax.ParticleMixture) -> dict[str, Float[Array, "objects 2"]]:
    """The mean and the component-wise median of the particles."""
    places = mixture.particles["now"]
    order = jnp.argsort(places, axis=0)
    upto = jnp.cumsum(mixture.weights[order], axis=0)
    middle = jnp.sum(upto < 0.5, axis=0, keepdims=True)
    ranked = jnp.take_along_axis(places, order, axis=0)
    median = jnp.take_along_axis(ranked, jnp.minimum(middle, len(places) - 1), axis=0)[0]
    return {"mean": mixture.average(places), "median": median}


def run_method(method: str, setting: Setting, num_runs: int, seed: int) -> dict[str, np.ndarray]:
    """Whether each object is tracked, by each estimate: (orders, runs, t, objects)."""
    key_scenes, key_runs = jax.random.split(jax.random.key(seed))
    scenes = jax.vmap(setting.make)(jax.random.split(key_scenes, num_runs))
    keys = jax.random.split(key_runs, num_runs)
    num_orders, orders = 1, None
    if method == "ps":
        num_orders = setting.num_objects
        shifts = jnp.arange(num_orders)[:, None] + jnp.arange(num_orders)[None]
        orders = jnp.repeat(shifts.astype(jnp.int32) % num_orders, num_runs, axis=0)
        scenes = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * num_orders), scenes)
        keys = jnp.concatenate([keys] * num_orders)
    # What a cluster filter need not do it skips, but not for many runs side by side.
    runs_at_once = None if method in ONE_BY_ONE else RUNS_AT_ONCE
    make = METHODS[method][1]
    found = run_all(make, setting.num_particles, keys, scenes, orders, runs_at_once)
    truth = boxes(scenes.places[:, 1:])
    shape = (num_orders, num_runs, NUM_FRAMES - 1, setting.num_objects)
    return {
        name: np.asarray(track_state(boxes(found[name]), truth)).reshape(shape)
        for name in ESTIMATES
    }


def boxes(centres: Float[Array, "*batch 2"]) -> Float[Array, "*batch 4"]:
    """(x, y, w, h), the top-left corner first."""
    return jnp.concatenate([centres - BOX / 2, jnp.full_like(centres, BOX)], axis=-1)
