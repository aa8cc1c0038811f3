"""The filters of the matrix: every recipe, every transform and every pair, every class of move."""

import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import mpfjax
from mpfjax import (
    Every,
    Filter,
    GaussNewtonProposal,
    KMeans,
    Merge,
    Pool,
    Propagate,
    PropagateNested,
    Prune,
    RandomPartition,
    Resample,
    Split,
)
from mpfjax.moves.propagation.propagate import Predict, Reweight

N, M = 40, 2


def plain(model):
    """What transforms are tried on: two components, and the moves that regroup them."""
    moves = [Resample(), Propagate(), KMeans(1)]
    return Filter(model, moves, N, M, initial_moves=[KMeans(1, reseed=True)])


def chain(*moves, m=M):
    """A chain of moves, made anew for each model."""
    initial = [RandomPartition()] if m > 1 else []
    return lambda model: Filter(model, moves, N, m, initial_moves=initial)


def recipe(name, *sizes, **options):
    return lambda model: getattr(mpfjax, name)(model, N, *sizes, **options)


def side(states):
    """On which side of zero the first number of the state is."""
    leaf = jax.tree.leaves(states)[-1]
    return (leaf.reshape(len(leaf), -1)[:, 0] > 0).astype(jnp.int32)


def identity(key, mixture, now):
    return mixture


def shifted(key, mixture, now):
    """An initial move of one's own that is wrong."""
    return mixture.replace(log_weights=mixture.log_weights - 1.0)


GAUSS = GaussNewtonProposal()
RECIPES: dict[str, Callable[[Any], Filter]] = {
    "particle": recipe("particle_filter"),
    "guided": recipe("particle_filter", proposal=GAUSS),
    "auxiliary": recipe("auxiliary_particle_filter", GAUSS),
    "mixture": recipe("mixture_particle_filter", M),
    "mixture rqmc": recipe("mixture_particle_filter", M, noise="rqmc"),
    "Gaussian": recipe("gaussian_particle_filter"),
    "Gaussian, predictive": recipe("gaussian_particle_filter", importance="predictive_gaussian"),
    "Gaussian mixture": recipe("gaussian_mixture_particle_filter", M),
    "partitioned": recipe("partitioned_sampling"),
    "distributed": recipe("distributed_partitioned_sampling"),
    "distributed, evidence": recipe("distributed_partitioned_sampling", reassembly="evidence"),
    "independent": recipe("independent_particle_filters"),
    "clustered": recipe("clustered_particle_filter"),
    "Bernoulli": lambda model: mpfjax.bernoulli_filter(
        model, 400, 2, particles_per_birth=100, undetected_particles=200
    ),
}
TRANSFORMS: dict[str, Callable[[Filter], Filter]] = {
    "point sets": mpfjax.with_quasi_monte_carlo,
    "score": mpfjax.with_score_gradient,
    "two draws": lambda filter: mpfjax.with_proposals_per_particle(filter, 2),
    "look-ahead": mpfjax.with_lookahead,
    "selected start": mpfjax.with_initial_selection,
    "start": lambda filter: mpfjax.with_initialisation(filter, 2),
    "restarts": lambda filter: mpfjax.with_restarts(filter, num_observations=2),
    "alarm": mpfjax.with_alarm,
    "families": lambda filter: mpfjax.with_eve_indices(
        mpfjax.with_resampling(filter, Resample("multinomial"))
    ),
    "stratified": lambda filter: mpfjax.with_resampling(filter, Resample("stratified")),
}
MOVES: dict[str, Callable[[Any], Filter]] = {
    "Predict, Reweight": chain(Resample(), Predict(), Reweight()),
    "PropagateNested": chain(Resample(), PropagateNested(Propagate(), 3)),
    "PropagateRegimes": chain(Resample(), mpfjax.PropagateRegimes()),
    "RandomWalkMetropolis": chain(Propagate(), Resample(), mpfjax.RandomWalkMetropolis()),
    "Metropolis beside stop": chain(
        Propagate(gradient="stop"), Resample(gradient="stop"), mpfjax.RandomWalkMetropolis()
    ),
    "pathwise": chain(Resample(gradient="stop"), Propagate()),
    "Merge, Split": chain(Resample(), Propagate(), Merge(), Split()),
    "Prune": chain(Resample(), Propagate(), Prune(0.2)),
    "Pool": chain(Resample(), Propagate(), Pool()),
    "GroupBy": chain(Resample(), Propagate(), mpfjax.GroupBy(side)),
    "Every": chain(Every(2, [Resample()]), Propagate()),
    "IslandInteraction": chain(mpfjax.IslandInteraction(1.0), Resample(), Propagate()),
    "Exclusion": chain(Resample(), Propagate(), mpfjax.Exclusion(strength=1.0, radius=0.5)),
    "own function": lambda model: Filter(model, [Resample(), Propagate(), identity], N),
    "initially Gaussian": lambda model: Filter(
        model, [Resample(), Propagate()], N, initial_moves=[mpfjax.GaussianRegeneration()]
    ),
    "initially own function": lambda model: Filter(
        model, [Resample(), Propagate()], N, initial_moves=[shifted]
    ),
}


def with_one(name):
    return lambda model: TRANSFORMS[name](plain(model))


def with_two(first, second):
    return lambda model: TRANSFORMS[second](TRANSFORMS[first](plain(model)))


SINGLE = {f"with {name}": with_one(name) for name in TRANSFORMS}
PAIRS = {
    f"with {one} > {two}": with_two(one, two)
    for one, two in itertools.product(TRANSFORMS, repeat=2)
}
FILTERS = RECIPES | SINGLE | MOVES | PAIRS
# Approximate filters whose law is another one at any number of particles.
OF_ANOTHER_LAW = ("Prune", "Exclusion", "own function", "initially own function")
# It also weighs that there is no object, or several.
OF_OTHER_EVIDENCE = ("Bernoulli",)


def parts(name: str) -> frozenset[str]:
    """What a filter is made of: its transforms, and itself."""
    if not name.startswith("with "):
        return frozenset({name, *OTHER_PARTS.get(name, ())})
    return frozenset({name, *name.removeprefix("with ").split(" > ")})


OTHER_PARTS = {"mixture rqmc": ("point sets",)}
