"""The filters of the literature, each defined in a few lines by its moves."""

from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Array, PyTree

from mpfjax import transforms
from mpfjax.checks import Count, Share, checked
from mpfjax.filter import Filter
from mpfjax.lookahead.pilot import Lookahead
from mpfjax.models.base import AbstractStateSpaceModel, over_particles
from mpfjax.models.conditionally_linear import is_marginalised
from mpfjax.models.law import refuse_marginalised
from mpfjax.models.multi_object import MultiObjectModel
from mpfjax.models.noise import Noise
from mpfjax.models.targets import TargetsModel
from mpfjax.moves.base import AbstractMove, AbstractProposal, Gradient, as_moves
from mpfjax.moves.every import Every
from mpfjax.moves.objects.bernoulli import Associate
from mpfjax.moves.objects.clusters import PropagateInClusters
from mpfjax.moves.objects.independent import PropagateIndependently
from mpfjax.moves.objects.partitioned import Partitioned, Reassembly, circular_orders
from mpfjax.moves.propagation.propagate import Predict, Propagate, Reweight
from mpfjax.moves.regrouping.features import OnCircles, Scale
from mpfjax.moves.regrouping.kmeans import KMeans
from mpfjax.moves.regrouping.merge import Merge
from mpfjax.moves.regrouping.partitions import Pool, RandomPartition
from mpfjax.moves.regrouping.split import Split
from mpfjax.moves.resampling.gaussian import GaussianRegeneration, RegenerateObjects
from mpfjax.moves.resampling.resample import Resample, Scheme

Importance = Literal["propagated", "predictive_gaussian"]
# K-means starts from the components of a few steps before, and needs few iterations.
_WARM_ITERATIONS, _ITERATIONS = 2, 5


@checked
def particle_filter(
    model: AbstractStateSpaceModel,
    num_particles: Count,
    *,
    proposal: AbstractProposal | None = None,
    scheme: Scheme = "systematic",
    ess_threshold: Share = 1.0,
    noise: Noise = "independent",
    gradient: Gradient = "none",
) -> Filter:
    """The standard particle filter: resample, propagate.

    Vermaak et al. (2003), section 3, with one component; a bootstrap filter unless a proposal is
    given. Use it for unimodal posteriors; when the posterior is multimodal, it eventually loses all
    modes but one. `noise="rqmc"` is `with_quasi_monte_carlo`, and `gradient="stop"`, for tuning,
    `with_score_gradient`.
    """
    moves = [Resample(scheme, ess_threshold=ess_threshold), Propagate(proposal)]
    return _with(noise, gradient, Filter(model, moves, num_particles))


@checked
def auxiliary_particle_filter(
    model: AbstractStateSpaceModel,
    num_particles: Count,
    lookahead: Lookahead,
    *,
    proposal: AbstractProposal | None = None,
) -> Filter:
    """The auxiliary particle filter: resample by w times a look-ahead to y_t, propagate.

    Pitt and Shephard (1999). `lookahead` is a function (y_t, states) -> log ν of each particle, or
    a proposal with `log_normaliser`, which then also draws x_t unless another `proposal` is given.
    Ẑ is unbiased for any look-ahead; see `AuxiliaryResample`. With `GaussNewtonProposal(1,
    inflation=1.0)` for a `LinearGaussianModel` the filter is fully adapted: ν is p(y_t | x_{t-1}),
    x_t is drawn from p(x_t | x_{t-1}, y_t), and all weights are equal. Use it if the likelihood is
    narrow and y_t determines early which particles will survive. The filter is `with_lookahead`
    applied to a `particle_filter`, and can be applied to any other filter in the same way.
    """
    return transforms.with_lookahead(
        particle_filter(model, num_particles, proposal=proposal), lookahead
    )


@checked
def mixture_particle_filter(
    model: AbstractStateSpaceModel,
    num_particles: Count,
    max_components: Count,
    *,
    proposal: AbstractProposal | None = None,
    scheme: Scheme = "systematic",
    ess_threshold: Share = 1.0,
    features: Callable[[PyTree], Array] | None = None,
    scale: Scale = 1.0,
    regroup: Sequence[AbstractMove] | None = None,
    regroup_every: Count = 3,
    noise: Noise = "independent",
    gradient: Gradient = "none",
) -> Filter:
    """The mixture particle filter: resample within components, propagate, regroup.

    Vermaak et al. (2003), sections 3 and 4. Each component is resampled separately and competes
    with the others only through its mixture weight, so that no component takes particles from
    another. At every third step, components that overlap are merged, diffuse components are split,
    and two iterations of K-means refine the grouping, all of which is exact. If M is more than one,
    x_0 is selected by y_1 from four draws per particle (`SelectInitial`). If the prior is diffuse
    relative to the likelihood, use `with_initialisation`.

    - `features`, `scale`: the coordinates of a particle that the grouping moves compare, and their
      units, also for x_0 (see `KMeans`; features of one particle if the model is wrapped by
      `per_particle`).
    - `regroup`: moves that replace `Merge`, `Split` and `KMeans`, with their own features and
      thresholds.
    - `regroup_every`: k if they run at every k-th step (see `Every`). Use 1 if modes move fast, or
      if a `Merge` counts frames by its `patience`. The default, 3, loses nothing here;
      `gaussian_mixture_particle_filter` has 1, because a component that comes to contain two modes
      loses them at its next step.
    - `noise`: "rqmc" is `with_quasi_monte_carlo`: each component has a separate point set, and the
      mixture weights are far more accurate. It includes `with_lookahead`, unless there is a
      proposal or a conditionally linear model.
    - `gradient`: "stop" is `with_score_gradient`.

    Use it if the posterior has several modes that must all be retained.
    """
    plain = particle_filter(
        model, num_particles, proposal=proposal, scheme=scheme, ess_threshold=ess_threshold
    )
    options = _grouping_options(model, features, scale)
    filter = _mixture(plain, max_components, options, _WARM_ITERATIONS, regroup, regroup_every)
    if max_components > 1:
        filter = transforms.with_initial_selection(filter)
    if noise == "rqmc" and proposal is None and not is_marginalised(model):
        filter = transforms.with_lookahead(filter)
    return _with(noise, gradient, filter)


@checked
def gaussian_particle_filter(
    model: AbstractStateSpaceModel,
    num_particles: Count,
    *,
    proposal: AbstractProposal | None = None,
    regeneration: GaussianRegeneration | None = None,
    importance: Importance = "propagated",
) -> Filter:
    """The Gaussian particle filter: redraw from the Gaussian of the moments, propagate.

    Kotecha and Djuric (2003); Lin et al. (2012), section 3. It is an approximation for filtering
    distributions that are close to a Gaussian, and cannot retain two modes.
    `gaussian_mixture_particle_filter` describes `importance`.
    """
    refuse_marginalised(model, "gaussian_particle_filter")
    redraw = GaussianRegeneration() if regeneration is None else regeneration
    if importance == "propagated":
        return Filter(model, [redraw, Propagate(proposal)], num_particles)
    if proposal is not None:
        raise ValueError(f"importance: {importance!r} draws from no proposal, but one was given")
    return Filter(model, [redraw, Predict(), redraw, Reweight()], num_particles)


@checked
def gaussian_mixture_particle_filter(
    model: AbstractStateSpaceModel,
    num_particles: Count,
    max_components: Count,
    *,
    proposal: AbstractProposal | None = None,
    regeneration: GaussianRegeneration | None = None,
    importance: Importance = "propagated",
    features: Callable[[PyTree], Array] | None = None,
    scale: Scale = 1.0,
    regroup: Sequence[AbstractMove] | None = None,
    regroup_every: Count = 1,
) -> Filter:
    """GM-MPF: redraw each component from the Gaussian of its moments, propagate, regroup.

    Lin et al. (2012), section 4: the mixture particle filter with Gaussian regeneration instead of
    resampling. The paper can be interpreted in two ways as to what is drawn from the importance
    function q of eqs. 8 and 9, and `importance` selects one. "propagated": particles are drawn from
    the Gaussian of the filtering distribution, propagated by the dynamics (or by `proposal`), and
    weighted by L (or L D / q). "predictive_gaussian": these particles only determine the moments of
    the prediction (eqs. 12 and 13); new particles are drawn from its Gaussian, N(μ̄, Σ̄), and
    weighted by L, because the Gaussian cancels in eq. 8. The second is one more approximation and
    requires one more draw. `mixture_particle_filter` describes the other arguments. Components are
    regrouped at every step, because the Gaussian of a component with two modes is centred between
    them. With `regroup_every=3` 12% of 400 runs lose a mode, with 1 one per cent (`python -m
    benchmarks.score_vs_particles --filters gm_mpf --seeds 400 --particles 100`).

    The filter is an approximation that is accurate if each mode is close to a Gaussian. Raises
    `ValueError` for another `importance`, and for "predictive_gaussian" with a `proposal`.
    """
    plain = gaussian_particle_filter(
        model, num_particles, proposal=proposal, regeneration=regeneration, importance=importance
    )
    options = _grouping_options(model, features, scale)
    return _mixture(plain, max_components, options, _ITERATIONS, regroup, regroup_every)


@checked
def partitioned_sampling(
    model: MultiObjectModel, num_particles: Count, order: Sequence[int] | Array | None = None
) -> Filter:
    """Partitioned sampling: resample, then propagate one object after the other.

    MacCormick and Blake (1999); Smith and Gatica-Perez (2004), section 3. `order` is a permutation
    of the objects 0, ..., J-1; None is 0, ..., J-1. It needs far fewer particles than the joint
    particle filter, `particle_filter` on the same model, but the first objects of the order retain
    only a few distinct hypotheses and hardly recover from an occlusion. It is unbiased for every
    order, also with an interaction. `map_moves` changes its resampling, between steps and objects.
    """
    return Filter(model, [Resample(), Partitioned(order)], num_particles)


@checked
def distributed_partitioned_sampling(
    model: MultiObjectModel,
    num_particles: Count,
    orders: Sequence[Sequence[int]] | Array | None = None,
    reassembly: Reassembly = "prior",
) -> Filter:
    """DPS: the particles are divided into C sets, with another order of the objects in each.

    Smith and Gatica-Perez (2004), section 4: pool and resample, divide the particles into C sets at
    random, apply partitioned sampling in each, reassemble. A fixed order leaves few distinct
    hypotheses of its first objects; here all objects share this loss. `orders` are C permutations
    of the objects; None is the J circular shifts. `reassembly` is "prior", the paper's, in which
    the weight of every set returns to 1/C (an approximation: the marginal likelihood is biased), or
    "evidence", which is exact. See `Partitioned` for both. Use it if it is unknown which object
    will be difficult to track, and N/C particles are sufficient to track all.
    """
    rows = circular_orders(model.num_objects) if orders is None else orders
    partitioned = Partitioned(rows, reassembly=reassembly)
    moves = [Pool(), Resample(), RandomPartition(), partitioned]
    return Filter(model, moves, num_particles, len(partitioned.orders))


@checked
def independent_particle_filters(model: MultiObjectModel, num_particles: Count) -> Filter:
    """A separate particle filter for each object, which ignores the other objects.

    Each object has N particles, and a step evaluates as many likelihoods as a joint filter with N
    particles. It is exact if the objects do not interact, and is then the best choice. It ignores
    any interaction: filters of similar objects that cross may end on the same object. Estimates are
    after resampling; see `PropagateIndependently`.
    """
    ignores = model.interaction is not None
    move = PropagateIndependently(ignores_interaction=ignores)
    return Filter(model, [move], num_particles)


@checked
def clustered_particle_filter(model: MultiObjectModel, num_particles: Count) -> Filter:
    """A joint filter for each cluster of objects; clusters merge when objects meet.

    Every object starts with a separate particle filter. Two objects meet if the interaction ψ
    between any of their predicted points differs from 1. Their filters then become one joint
    filter, weighted by ψ, in which the points of an object are recombined among rows: each of an
    object's N points serves every row, with the weight L f(point | row) / Σ f(point | any row).
    Without interaction it equals `independent_particle_filters`; with interaction it is unbiased. A
    step evaluates N x J likelihoods, as in partitioned sampling. `PropagateInClusters` has the
    derivation, the options and the methods that the object model must define.

    Use it instead of a joint filter, PS or DPS if ψ has compact support, as in `PairwiseRepulsion`;
    otherwise all objects become one cluster immediately. Estimates are after resampling. The
    distribution of a cluster may have several modes, such as two similar objects in either order.
    Their mean is then a position without an object: use the median.
    """
    return Filter(model, [PropagateInClusters()], num_particles)


@checked
def bernoulli_filter(
    model: TargetsModel,
    num_particles: Count,
    max_targets: Count,
    *,
    proposal: AbstractProposal | None = None,
    particles_per_birth: Count = 50,
    undetected_particles: Count = 400,
) -> Filter:
    """An unknown number of objects that appear and disappear: predict, associate.

    A particle implementation of the Poisson multi-Bernoulli filter (Williams 2015): each of
    `max_targets` components is a potential object with its own existence probability, and one more
    component represents the intensity of undetected objects. `estimate_targets` summarises the
    objects. `Associate` describes the algorithm and the last two arguments.

    - `num_particles`: in total: `undetected_particles`, and a hundred or more per object.
    - `max_targets`: more than the number of measurements per scan if objects may appear anywhere.

    Each object is redrawn from its Gaussian, for which a few particles are sufficient. If
    `map_moves` changes the `resample` of `Associate` to `Resample()`, its distribution may have any
    shape, but then all its particles descend from its first ones, which must be numerous. Use the
    filter with a `TargetsModel` if neither the number of objects nor the origin of the measurements
    is known. For a single object use a filter with `ClutteredModel`, for boxes in a video
    `vision.ObjectTracker`.
    """
    associate = Associate(
        particles_per_birth, undetected_particles, RegenerateObjects(noise="rqmc")
    )
    return Filter(model, [Predict(proposal), associate], num_particles, max_targets + 1)


def _grouping_options(
    model: AbstractStateSpaceModel, features: Callable[[PyTree], Array] | None, scale: Scale
) -> dict[str, Any]:
    """The features and scale of the grouping moves: by default the state, with its periods."""
    periods = jax.tree.leaves(getattr(model, "periods", None))
    if features is not None or not periods:
        return {"features": over_particles(model, features), "scale": scale}
    flat = np.concatenate([*map(np.ravel, periods)])
    return {"features": OnCircles(tuple(flat.tolist())), "scale": scale}


def _mixture(
    plain: Filter,
    max_components: Count,
    options: dict[str, Any],
    num_iterations: int,
    regroup: Sequence[AbstractMove] | None,
    regroup_every: Count,
) -> Filter:
    """The filter with many components, which moves regroup; x_0 grouped by K-means from seeds."""
    if regroup is None:
        regroup = [Merge(**options), Split(**options), KMeans(num_iterations, **options)]
    regroup = as_moves(regroup, "regroup")
    if regroup and regroup_every > 1:
        regroup = (Every(regroup_every, regroup),)
    return plain.replace(
        moves=[*plain.moves, *regroup],
        num_components=max_components,
        initial_moves=[KMeans(10, reseed=True, **options)],
    )


def _with(noise: str, gradient: str, filter: Filter) -> Filter:
    """The filter with the two options of recipes that are transforms."""
    filter = transforms.with_quasi_monte_carlo(filter) if noise == "rqmc" else filter
    return transforms.with_score_gradient(filter) if gradient == "stop" else filter
