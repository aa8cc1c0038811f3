"""Moves, and chains with what the matrix has not, by name: they inherit the contracts.

`REGROUPINGS` and `WITHIN_COMPONENTS` are held to the contracts of their kind by
`tests/moves/test_contracts.py`, `CHAINS` to those of filters by `tests/together/test_chains.py`. A
new move or filter is one new line below; the tests then find it.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

import mpfjax
from mpfjax import (
    AbstractRegrouping,
    AbstractResampling,
    Every,
    Filter,
    GaussianRegeneration,
    GaussNewtonProposal,
    GroupBy,
    KMeans,
    Merge,
    MultiObjectModel,
    Pool,
    Propagate,
    RandomPartition,
    RandomWalkMetropolis,
    Resample,
    Split,
)
from mpfjax.moves.objects.clusters import PropagateInClusters
from mpfjax.moves.resampling.gaussian import RegenerateObjects

NUM_PARTICLES = 48
# On either side of the number of components up to which they are worked on as rows.
NUM_COMPONENTS, MANY_COMPONENTS = 3, 6


# What is done in another way for many.
OTHERWISE_OF_MANY = ("mpf", "mpf rqmc", "guided, sorted", "random labels, stratified")


class RandomLabels(AbstractRegrouping):
    """A regrouping of our own: every particle to a component drawn at random."""

    def regroup(self, key, mixture):
        labels = jax.random.randint(key, (mixture.num_particles,), 0, mixture.num_components)
        return labels.astype(jnp.int32), mixture.memory


REGROUPINGS: dict[str, AbstractRegrouping] = {
    "kmeans": KMeans(),
    "kmeans reseeded": KMeans(3, reseed=True),
    "kmeans on one feature": KMeans(features=lambda states: states[:, 0], scale=0.5),
    "merge by deviations": Merge(),
    "merge by distance": Merge(None, max_distance=1.0, scale=(1.0, 2.0)),
    "patient merge": Merge(2.0, max_distance=1.0, patience=2),
    "split": Split(),
    "eager split": Split(1.0, min_distance=0.1, min_share=0.0),
    "random labels": RandomLabels(),
    "pool": Pool(),
    "random partition": RandomPartition(),
    "grouped by a label": GroupBy(lambda states: (states[:, 0] > 0).astype(jnp.int32)),
}

WITHIN_COMPONENTS: dict[str, AbstractResampling] = {
    "systematic": Resample(),
    "stratified": Resample("stratified"),
    "multinomial": Resample("multinomial"),
    "multinomial, adaptive": Resample("multinomial", ess_threshold=0.5),
    "systematic, along a Hilbert curve, adaptive": Resample(ess_threshold=0.5, along_curve=True),
    "stratified, fixed number, adaptive": Resample(
        "stratified", ess_threshold=0.5, particles_per_component=5
    ),
    "stratified, shared equally": Resample("stratified", allocation="equal"),
    "gaussian": GaussianRegeneration(),
    "gaussian, fixed number, stratified": GaussianRegeneration(
        particles_per_component=5, noise="stratified"
    ),
    "gaussian, point sets": GaussianRegeneration(noise="rqmc"),
    "gaussian, of objects": RegenerateObjects(),
}


def _pf(**options) -> Callable[..., Filter]:
    return lambda model: mpfjax.particle_filter(model, NUM_PARTICLES, **options)


def _mpf(m: int = NUM_COMPONENTS, **options) -> Callable[..., Filter]:
    return lambda model: mpfjax.mixture_particle_filter(model, NUM_PARTICLES, m, **options)


def _chain(*before, m: int = NUM_COMPONENTS, then=(), proposal=None) -> Callable[..., Filter]:
    return lambda model: Filter(
        model,
        [*before, Propagate(proposal), *then],
        NUM_PARTICLES,
        m,
        initial_moves=[KMeans(3, reseed=True)],
    )


def _joint(make: Callable[[MultiObjectModel], Filter]) -> Callable[..., Filter]:
    """A filter of two objects, independent copies that give rise to the same observations."""
    return lambda model: make(MultiObjectModel(model, 2, shared_observation=True))


def _side(states):
    """Which side of zero the first number of the state is on."""
    return (states.reshape(NUM_PARTICLES, -1)[:, 0] > 0).astype(jnp.int32)


def _of_components(m: int) -> dict[str, Callable[..., Filter]]:
    """The chains that regroup, with M components."""
    return {
        "mpf": _mpf(m),
        "mpf rqmc": _mpf(m, noise="rqmc"),
        "guided mpf rqmc, adaptive": lambda model: mpfjax.with_quasi_monte_carlo(
            mpfjax.with_resampling(
                _mpf(m, proposal=GaussNewtonProposal())(model), Resample(ess_threshold=0.5)
            )
        ),
        "guided mpf": _mpf(m, proposal=GaussNewtonProposal()),
        "guided, sorted": _chain(
            Resample(along_curve=True), m=m, proposal=GaussNewtonProposal(), then=[KMeans(2)]
        ),
        "patient merge": _chain(Resample(), m=m, then=[Merge(2.0, max_distance=1.0, patience=2)]),
        "grouped by a label": _chain(Resample(), m=m, then=[GroupBy(_side)]),
        "kmeans only": _chain(Resample("stratified"), m=m, then=[KMeans()]),
        "split only, adaptive": _chain(Resample(ess_threshold=0.5), m=m, then=[Split(2.0)]),
        "random labels, stratified": _chain(RandomLabels(), Resample("stratified"), m=m),
        "gaussian mixture": _chain(GaussianRegeneration(), m=m, then=[KMeans()]),
    }


# One of each kind of filter and of each way to do its sums.
QUICK_CHAINS = ("pf rqmc", "mpf", "gaussian mixture")
CHAINS: dict[str, Callable[..., Filter]] = {
    "pf": _pf(),
    "pf adaptive": _pf(ess_threshold=0.5),
    "pf rqmc": _pf(noise="rqmc"),
    **_of_components(NUM_COMPONENTS),
    **{
        f"{name}, M = {MANY_COMPONENTS}": chain
        for name, chain in _of_components(MANY_COMPONENTS).items()
        if name in OTHERWISE_OF_MANY
    },
    "every second step a random walk": _chain(
        Resample(), then=[Every(2, [RandomWalkMetropolis()])]
    ),
    "dps": _joint(
        lambda joint: mpfjax.distributed_partitioned_sampling(
            joint, NUM_PARTICLES, reassembly="evidence"
        )
    ),
    "objects that cross in one cluster": _joint(
        lambda joint: mpfjax.Filter(joint, [PropagateInClusters("together")], NUM_PARTICLES)
    ),
}
