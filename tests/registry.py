"""Every move and every chain of moves, by name: what is listed here inherits the contracts.

`REGROUPINGS` and `REJUVENATIONS` are held to the contracts of their kind by
`tests/moves/test_contracts.py`, `CHAINS` to those of filters by `tests/test_chains.py`. A new
move or filter is one new line below; the tests then find it.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

import mpfjax
from mpfjax import (
    AbstractRegrouping,
    AbstractRejuvenation,
    Exclusion,
    Filter,
    GaussianRegeneration,
    GaussNewtonProposal,
    KMeans,
    Merge,
    MultiObjectModel,
    Partitioned,
    Pool,
    Predict,
    Propagate,
    RandomPartition,
    Resample,
    Split,
    Weigh,
)

NUM_PARTICLES = 48
NUM_COMPONENTS = 3


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
    "merge by distance": Merge(None, 1.0, scale=(1.0, 2.0)),
    "patient merge": Merge(2.0, 1.0, patience=2),
    "split": Split(),
    "eager split": Split(1.0, 0.1, min_share=0.0),
    "random labels": RandomLabels(),
    "pool": Pool(),
    "random partition": RandomPartition(),
    "random partition in two": RandomPartition(2),
}

REJUVENATIONS: dict[str, AbstractRejuvenation] = {
    "systematic": Resample(),
    "stratified": Resample("stratified"),
    "multinomial": Resample("multinomial"),
    "residual": Resample("residual"),
    "systematic, adaptive": Resample(ess_threshold=0.5),
    "multinomial, adaptive": Resample("multinomial", ess_threshold=0.5),
    "systematic, sorted": Resample(sort_by=lambda states: states[:, 0]),
    "systematic, fixed number": Resample(particles_per_component=5),
    "residual, fixed number, adaptive": Resample("residual", 0.5, 5),
    "gaussian": GaussianRegeneration(),
    "gaussian, fixed number, stratified": GaussianRegeneration(5, noise="stratified"),
}


def _pf(**options) -> Callable[..., Filter]:
    return lambda model: mpfjax.particle_filter(model, NUM_PARTICLES, **options)


def _mpf(**options) -> Callable[..., Filter]:
    return lambda model: mpfjax.mixture_particle_filter(
        model, NUM_PARTICLES, NUM_COMPONENTS, **options
    )


def _chain(*before, then=(), proposal=lambda model: None) -> Callable[..., Filter]:
    return lambda model: Filter(
        model,
        [*before, Propagate(model, proposal(model)), *then],
        NUM_PARTICLES,
        NUM_COMPONENTS,
        initial_moves=[KMeans(3, reseed=True)],
    )


def _joint(make: Callable[[MultiObjectModel], Filter]) -> Callable[..., Filter]:
    """A filter of two objects, independent copies that give rise to the same observations."""
    return lambda model: make(MultiObjectModel(model, 2, shared_observation=True))


CHAINS: dict[str, Callable[..., Filter]] = {
    "pf": _pf(),
    "pf multinomial": _pf(scheme="multinomial"),
    "pf adaptive": _pf(ess_threshold=0.5),
    "guided pf": lambda model: _pf(proposal=GaussNewtonProposal(model))(model),
    "mpf": _mpf(),
    "mpf fixed number": _mpf(particles_per_component=12),
    "guided mpf": lambda model: _mpf(proposal=GaussNewtonProposal(model))(model),
    "guided, sorted, stratified noise": _chain(
        Resample(sort_by=lambda states: states.reshape(NUM_PARTICLES, -1)[:, 0]),
        proposal=lambda model: GaussNewtonProposal(model, noise="stratified"),
        then=[KMeans(2)],
    ),
    "patient merge": _chain(Resample(), then=[Merge(2.0, 1.0, patience=2)]),
    "kmeans only": _chain(Resample("stratified"), then=[KMeans()]),
    "split only, adaptive": _chain(Resample(ess_threshold=0.5), then=[Split(2.0)]),
    "random labels, multinomial": _chain(Resample("multinomial"), then=[RandomLabels()]),
    "random labels, residual": _chain(RandomLabels(), Resample("residual")),
    "never resampled": _chain(),
    "predict and weigh": lambda model: Filter(
        model, [Resample(), Predict(model), Weigh(model)], NUM_PARTICLES
    ),
    "gaussian mixture": _chain(GaussianRegeneration(), then=[KMeans()]),
    "predictive Gaussian": lambda model: mpfjax.gaussian_mixture_particle_filter(
        model, NUM_PARTICLES, NUM_COMPONENTS, importance="predictive_gaussian"
    ),
    "exclusion": _chain(Resample("stratified"), then=[Exclusion(2.0, 0.5), KMeans(3, reseed=True)]),
    "joint pf": _joint(_pf()),
    "ps": _joint(lambda joint: mpfjax.partitioned_sampling(joint, NUM_PARTICLES, (1, 0))),
    "ps adaptive, random order": _joint(
        lambda joint: mpfjax.partitioned_sampling(
            joint, NUM_PARTICLES, "random", scheme="multinomial", ess_threshold=0.5
        )
    ),
    "dps": _joint(
        lambda joint: mpfjax.distributed_partitioned_sampling(
            joint, NUM_PARTICLES, reassembly="evidence"
        )
    ),
    "dps prior": _joint(
        lambda joint: mpfjax.distributed_partitioned_sampling(joint, NUM_PARTICLES)
    ),
    "partitioned in clusters": _joint(
        lambda joint: Filter(
            joint,
            [Resample(), KMeans(), Partitioned(joint, "circular")],
            NUM_PARTICLES,
            NUM_COMPONENTS,
            initial_moves=[KMeans(3, reseed=True)],
        )
    ),
    "independent filters": _joint(
        lambda joint: mpfjax.independent_particle_filters(joint, NUM_PARTICLES)
    ),
    "clusters": _joint(
        lambda joint: mpfjax.clustered_particle_filter(joint, NUM_PARTICLES, scheme="stratified")
    ),
    "objects that cross in one cluster": _joint(
        lambda joint: mpfjax.clustered_particle_filter(joint, NUM_PARTICLES, start="together")
    ),
}
