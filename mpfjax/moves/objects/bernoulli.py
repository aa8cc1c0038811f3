"""Objects that appear and disappear: one component each, with all associations marginalised."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, Shaped

from mpfjax.checks import Count, check
from mpfjax.mixture import ParticleMixture, flatten_states, no_ancestors, single_component
from mpfjax.models.clutter import fill_missing, measurement_mask
from mpfjax.models.targets import TargetsModel
from mpfjax.moves.base import AbstractResampling, AbstractWrapper, Step
from mpfjax.moves.objects.association import associate
from mpfjax.operations.islands import num_islands
from mpfjax.operations.logarithms import add_gradient, exp, log_or_nothing
from mpfjax.operations.random import split, uniform
from mpfjax.operations.stored import take

TARGETS = "targets"
_LEAST_EXISTENCE = 1e-4  # of an object with a component: one less probable needs no particles
_NEAREST = 16  # undetected particles at a measurement that say how many objects to expect there
_FAR = 1e6  # a difference of log odds beyond which particles are equally far
_ENOUGH = 8.0  # effective particles at a measurement, from which an object may begin
_SAME = 2.0  # variances by which two components may differ that may describe one object


class _Intensity(NamedTuple):
    """How many objects to expect at each particle, as a step goes on.

    The first u particles are of objects that no measurement has revealed, v old ones and then new
    ones. The others are of m objects that may exist, each in an `owners` of its own.
    `starts` are the sensors, from 1 on, whose last scan revealed an object first, 0 for older ones.
    `references` are the masses of the undetected particles as draws of a newborn object, 0 of those
    that had a component, and `densities` how many times as many old objects are at each.
    """

    states: PyTree
    masses: Float[Array, " p"]
    owners: Int[Array, " q"]
    starts: Int[Array, " m"]
    references: Float[Array, " u"]
    densities: Float[Array, " v"]
    log_evidence: Float[Array, ""]

    def sums(self, values: Float[Array, "p *k"]) -> Float[Array, "m *k"]:
        """Over each object's particles."""
        values = values[len(self.references) :]
        return jax.ops.segment_sum(values, self.owners, len(self.starts))

    def of_owners(
        self, objects: Shaped[Array, "m *k"], undetected: float = 0
    ) -> Shaped[Array, "p *k"]:
        """What belongs to each particle's object, or to those that are not detected."""
        first = jnp.full((len(self.references), *objects.shape[1:]), undetected, objects.dtype)
        return jnp.concatenate([first, take(objects, self.owners)])

    def with_objects(
        self, born: PyTree, parents: Int[Array, "k b"], masses: Float[Array, "k b"], sensor: int
    ) -> "_Intensity":
        """With one more object for each measurement of a sensor.

        `parents` below v are old undetected particles, others the `born` of the measurement.
        """
        num_old, (num_new, size) = len(self.densities), parents.shape
        places = jnp.arange(num_new, dtype=jnp.int32)[:, None]
        offsets = len(self.masses) + places * size - num_old
        parents = jnp.where(parents < num_old, parents, parents + offsets).reshape(-1)

        def join(old: Array, born: Array) -> Array:
            every = jnp.concatenate([old, born.reshape(-1, *old.shape[1:])])
            return jnp.concatenate([old, take(every, parents)])

        new_owners = jnp.repeat(len(self.starts) + places[:, 0], size)
        return self._replace(
            states=jax.tree.map(join, self.states, born),
            masses=jnp.concatenate([self.masses, masses.reshape(-1)]),
            owners=jnp.concatenate([self.owners, new_owners]),
            starts=jnp.pad(self.starts, (0, num_new), constant_values=sensor + 1),
        )


class Associate(AbstractWrapper):
    """Weight the objects by the measurements of a scan, over all associations, and start new ones.

    A particle implementation of the Poisson multi-Bernoulli filter (Williams 2015), with marginal
    association probabilities by belief propagation (Williams and Lau 2014; Meyer et al. 2018). The
    joint weights are the normalised intensity u of the objects; multiplied by the expected number
    of objects, which is stored in the memory, they are u. The u of component m >= 1 sum to the
    existence probability r_m of its object, those of component 0 to the expected number of
    undetected objects. After a `Predict`, with G_j = p_D N(y_j | x) / λ(y_j),

    1. Two components are merged if they describe one object that was started by different
       measurements: in each component of the state, the squared gap of their means and the gap of
       their variances sum to less than twice the lesser variance, their r sum to at most one, and
       the last scan of a sensor did not start both, since an object has one measurement in it. u is
       multiplied by p_S, and new objects are added to component 0.
    2. Each measurement may be the first of an object. The birth model proposes its particles at the
       measurement, weighted by how many objects, new or not yet detected, there are at this place
       for each newborn one. This ratio is averaged over the particles of component 0 that are
       nearest to the measurement, and exact where all undetected objects are distributed like
       newborn ones. If enough of these particles are at the measurement itself, they are drawn
       ∝ G_j u instead.
    3. Each u becomes u (1 - p_D) P(m has none) / P₀ + Σ_j u G_j P(m has j) / Σ_m u G_j, with the
       probabilities of `associate`, and u (1 - p_D) in component 0.
    4. The M most probable objects are retained, the first in component 1. Others, and those below
       1e-4, are moved to component 0 and are no longer distinguished, so that none is lost
       (Williams 2012).
    5. Each component is resampled, by `resample`, and component 0 systematically.

    The total weight grows by log p of the scan over log p of clutter alone, as in `ClutteredModel`.
    It is exact for one scan of one sensor in which no two objects compete for two measurements, if
    undetected objects are distributed like newborn ones. Five steps are approximate: belief
    propagation, whose log p is otherwise Bethe's; the merging of components; the ratio of step 2;
    step 4; and the product form after the scan of each sensor, by which objects are independent
    although the scan made them exclude each other, so that log Ẑ of several scans or sensors has an
    error. Labels count objects from 1. They are not identities once two objects have
    been close, for any filter. `memory["targets"]` contains the number, the labels, and how many
    objects were crowded out.

    - `particles_per_birth`: the number of particles of a new object at each measurement.
    - `undetected_particles`: the number of particles of component 0, which fill the first slots.
    - `resample`: the move that redraws each object, with a number of particles by its weight.

    Raises `ValueError` on islands, for `num_slots`, and if there are no slots for the objects.
    """

    particles_per_birth: Count = eqx.field(static=True)
    undetected_particles: Count = eqx.field(static=True)
    resample: AbstractResampling

    holds = ("resample",)
    approximate = True
    weighs = weighs_targets = True
    keeps_mass = False
    keeps_parents = False
    keeps_families = False

    def initial_memory(self, now: Step, num_components: int) -> dict[str, PyTree]:
        """The expected number, and the labels of all components, 0 for one without an object."""
        memory = {
            "number": getattr(now.model, "initial_number", jnp.zeros(())),
            "labels": jnp.zeros(num_components, jnp.int32),
            "starts": jnp.zeros(num_components, jnp.int32),
            "next_label": jnp.ones((), jnp.int32),
            "crowded_out": jnp.zeros(()),
            "references": jnp.full(self.undetected_particles, 1 / self.undetected_particles),
        }
        return {TARGETS: memory} | super().initial_memory(now, num_components)

    def check(self, now: Step, num_particles: int, num_components: int) -> None:
        """Raise a `ValueError` for a model of another kind, and if there is no room for objects."""
        check(TargetsModel, model=now.model)
        if num_components < 2:
            raise ValueError("num_components: 1 leaves no component for detected objects")
        size, least = self.undetected_particles, self.undetected_particles + num_components - 1
        if num_particles < least:
            which = f"is less than {least}, {size} undetected_particles and one for each object"
            raise ValueError(f"num_particles: {num_particles} {which}")
        self.resample.check(now, num_particles - size, num_components - 1)

    def __call__(self, key: Key[Array, ""], mixture: ParticleMixture, now: Step) -> ParticleMixture:
        """Weigh by each sensor's measurements in turn, then resample."""
        if mixture.usable_slots is not None or num_islands() > 1:
            raise ValueError("num_slots: Associate fills every slot, and is not for islands")
        model = now.model
        scans = () if now.observation is None else model.scans(now.observation)
        key_new, key_last, *keys = split(key, 2 + len(scans))
        intensity = self._predict(key_new, mixture, model)
        if scans:
            intensity = intensity._replace(starts=jnp.zeros_like(intensity.starts))
        for number, (key_scan, scan) in enumerate(zip(keys, scans, strict=True)):
            intensity = self._update(key_scan, intensity, model, scan, number)
        return self._resample(key_last, mixture, intensity)

    def _predict(
        self, key: Key[Array, ""], mixture: ParticleMixture, model: TargetsModel
    ) -> _Intensity:
        """The intensity before the scan: of survivors and new objects."""
        size, memory = self.undetected_particles, mixture.memory[TARGETS]
        number, references = memory["number"], memory["references"]
        components = _once_each(mixture, number, memory["starts"])
        masses = number * mixture.weights * model.survival(mixture.particles)
        undetected = jnp.where(components == 0, masses, 0.0)
        # In the first step these fill all slots, of which the first ones stand for all.
        old = jnp.sum(undetected) * _normalised(undetected[:size])
        rate = jnp.broadcast_to(model.birth.rate / size, (size,))

        def join(old: Array, new: Array) -> Array:
            return jnp.concatenate([old[:size], new.astype(old.dtype), old[size:]])

        return _Intensity(
            jax.tree.map(join, mixture.particles, model.birth.sample(key, size)),
            jnp.concatenate([old, rate, jnp.where(components > 0, masses, 0.0)[size:]]),
            jnp.maximum(components[size:] - 1, 0),
            memory["starts"][1:],
            jnp.append(references, jnp.full_like(references, 1 / size)),
            jnp.where(references > 0, old / jnp.where(references > 0, references, 1.0), 0.0),
            jnp.zeros_like(mixture.log_scale),
        )

    def _update(
        self,
        key: Key[Array, ""],
        before: _Intensity,
        model: TargetsModel,
        scan: PyTree,
        number: int,
    ) -> _Intensity:
        """The intensity given the measurements of one sensor."""
        key_born, key_drawn = split(key, 2)
        sensor, num_old = model.sensors[number], len(before.densities)
        log_odds, detection = sensor.log_odds(scan, before.states), sensor.detection(before.states)
        born, log_born = self._born(key_born, model, scan, number)
        density, is_dense = _density_at(log_odds[:num_old], detection[:num_old], before)
        log_born += jnp.log1p(jnp.where(is_dense, 0.0, density) / model.birth.rate)[:, None]
        highest = jnp.maximum(jnp.max(log_odds, axis=0), jnp.max(log_born, axis=1))
        units = jax.lax.stop_gradient(jnp.maximum(highest, 0.0))

        # G_j u of each pair, and of each measurement's first objects, in units of the measurement.
        likely = (before.masses * detection)[:, None] * exp(log_odds - units[None])
        begins = is_dense[:, None] | (before.references[None, :num_old] == 0)
        begins = jnp.where(begins, likely[:num_old].T, 0.0)
        starts = jnp.concatenate([begins, exp(log_born - units[:, None])], axis=1)

        unseen = before.masses * (1 - detection)
        missed = before.sums(unseen) + jnp.maximum(1 - before.sums(before.masses), 0.0)
        alone = jnp.exp(-units) + jnp.sum(starts, axis=1)
        association = associate(before.sums(likely), missed, alone)
        rows = association.row_sums
        replies = before.of_owners(association.replies / rows[:, None])
        masses = jnp.sum(likely * replies, axis=1) + unseen * before.of_owners(1 / rows, 1)
        log_evidence = association.log_total + jnp.sum(units)
        log_evidence -= jnp.sum((before.masses * detection)[: len(before.references)])

        parents, shares = _redrawn(key_drawn, starts, self.particles_per_birth)
        after = before._replace(masses=masses, log_evidence=before.log_evidence + log_evidence)
        return after.with_objects(born, parents, shares / association.column_sums[:, None], number)

    def _born(
        self, key: Key[Array, ""], model: TargetsModel, scan: PyTree, number: int
    ) -> tuple[PyTree, Float[Array, "k b"]]:
        """States proposed at each measurement, and log of the mass of each as that measurement's.

        Over that of clutter.
        """
        size, sensor = self.particles_per_birth, model.sensors[number]
        is_there = measurement_mask(scan)

        def propose(key: Key[Array, ""], measurement: PyTree) -> tuple:
            states, log_masses = model.birth.propose(key, measurement, size, number)
            one = jax.tree.map(lambda leaf: leaf[None], measurement)
            log_masses += sensor.log_odds(one, states)[:, 0]
            log_masses += log_or_nothing(sensor.detection(states))
            for earlier in model.sensors[:number]:
                log_masses += log_or_nothing(1 - earlier.detection(states))
            return states, log_masses + jnp.log(model.birth.rate / size)

        states, log_masses = jax.vmap(propose)(split(key, is_there.shape[0]), fill_missing(scan))
        return states, jnp.where(is_there[:, None], log_masses, -jnp.inf)

    def _assign_components(
        self, memory: dict[str, Array], intensity: _Intensity, most: int
    ) -> tuple[Int[Array, " p"], dict[str, Array]]:
        """The component of each particle: the most probable objects have one. And the memory."""
        existence = jax.lax.stop_gradient(intensity.sums(intensity.masses))
        order = jnp.argsort(-existence)
        is_probable = existence[order] >= _LEAST_EXISTENCE
        ranks = jnp.arange(len(order), dtype=jnp.int32)
        components = jnp.where(is_probable & (ranks < most), ranks + 1, 0)
        of_each = intensity.of_owners(jnp.zeros_like(components).at[order].set(components))
        stays = components[:most] > 0
        labels = jnp.pad(memory["labels"][1:], (0, len(order) - most))[order][:most]
        is_new = stays & (labels == 0)
        upto = jnp.cumsum(is_new, dtype=jnp.int32)
        labels = jnp.where(is_new, memory["next_label"] + upto - 1, jnp.where(stays, labels, 0))
        starts = jnp.where(stays, intensity.starts[order][:most], 0)
        return of_each, {
            "number": jnp.sum(intensity.masses),
            "starts": jnp.pad(starts, (1, 0)),
            "labels": jnp.pad(labels, (1, 0)),
            "next_label": memory["next_label"] + upto[-1],
            "crowded_out": jnp.sum(jnp.where(is_probable, existence[order], 0.0)[most:]),
        }

    def _resample(
        self, key: Key[Array, ""], mixture: ParticleMixture, intensity: _Intensity
    ) -> ParticleMixture:
        """The mixture's slots drawn from all particles, and the memory of the step."""
        size, most = self.undetected_particles, mixture.num_components - 1
        rest = mixture.num_particles - size
        of_each, memory = self._assign_components(mixture.memory[TARGETS], intensity, most)
        key_first, key_rest = split(key, 2)
        undetected = jnp.where(of_each == 0, intensity.masses, 0.0)
        references = _references(intensity)
        # Half of them as the objects are, half as newborn ones, so that no place is left without.
        chances = _normalised(undetected) + _normalised(references)
        (drawn,), (shares,) = _redrawn(key_first, jax.lax.stop_gradient(chances)[None], size)
        shares /= jax.lax.stop_gradient(jnp.where(chances > 0, chances, 1.0))[drawn]
        masses = shares * undetected[drawn]
        memory["references"] = _normalised(shares * references[drawn])
        objects = single_component(intensity.states, most + 1).replace(
            log_weights=log_or_nothing(jnp.where(of_each > 0, intensity.masses, 0.0)),
            component_indicators=of_each,
            usable_slots=jnp.asarray(rest, jnp.int32),
        )
        objects = self.resample.resample(key_rest, objects)

        def join(first: Array, others: Array) -> Array:
            return jnp.concatenate([first, others[:rest]])

        first = jax.tree.map(lambda leaf: take(leaf, drawn), intensity.states)
        number = memory["number"]
        log_masses = join(log_or_nothing(masses), objects.log_weights)
        # Without any object to expect, the weights are still a distribution.
        log_none = jnp.where(jnp.arange(mixture.num_particles) < size, -jnp.log(size), -jnp.inf)
        log_weights = log_masses - jnp.log(jnp.where(number > 0, number, 1.0))
        return mixture.replace(
            particles=jax.tree.map(join, first, objects.particles),
            log_weights=jnp.where(number > 0, log_weights, log_none.astype(log_weights.dtype)),
            component_indicators=join(jnp.zeros_like(drawn), objects.component_indicators),
            ancestor_indices=no_ancestors(mixture),
            log_scale=mixture.log_scale + intensity.log_evidence,
            memory=mixture.memory | {TARGETS: memory},
        )


def _once_each(
    mixture: ParticleMixture, number: Float[Array, ""], starts: Int[Array, " m"]
) -> Int[Array, " n"]:
    """The component of each particle, after one that describes a more probable object joins it.

    Not two that the last scan of a sensor revealed: an object has one measurement in it.
    """
    existence = number * mixture.mixture_weights
    means = flatten_states(mixture.component_means())
    variances = jnp.diagonal(mixture.component_covariances(), axis1=1, axis2=2)
    least = jnp.minimum(variances[:, None], variances[None])
    gaps = (means[:, None] - means[None]) ** 2 + jnp.abs(variances[:, None] - variances[None])
    pairs = jnp.all(gaps < _SAME * least, axis=2)
    pairs &= existence[:, None] + existence[None] <= 1
    pairs &= (starts[:, None] != starts[None]) | (starts == 0)[None]
    pairs = jnp.triu(pairs, 1).at[0].set(False)
    pairs &= jnp.cumsum(pairs, axis=0) == 1  # each joins the most probable one
    pairs &= ~jnp.any(pairs, axis=0)[:, None]  # which does not join another
    pairs &= jnp.cumsum(pairs, axis=1) == 1  # and takes one
    places = jnp.arange(len(pairs), dtype=jnp.int32)
    choice = jnp.argmax(pairs, axis=0).astype(jnp.int32)
    return take(jnp.where(jnp.any(pairs, axis=0), choice, places), mixture.component_indicators)


def _density_at(
    log_odds: Float[Array, "v k"], detection: Float[Array, " v"], before: _Intensity
) -> tuple[Float[Array, " k"], Bool[Array, " k"]]:
    """How many times as many old undetected objects as newborn ones are at each measurement.

    An average over the nearest particles, by the sensor's own measure of what is near: log N(y_j|x)
    divided by a number. And whether so many particles are at the measurement itself that an object
    begins better at these.
    """
    num_old = len(log_odds)
    references = before.references[:num_old, None]
    log_odds = jax.lax.stop_gradient(jnp.where(references > 0, log_odds, -jnp.inf))
    highest = jnp.max(log_odds, axis=0)
    gaps = jnp.where(jnp.isfinite(highest), highest, 0.0)[None] - log_odds
    gaps = jnp.minimum(gaps, _FAR)
    reach = _kth_smallest(gaps, min(_NEAREST, num_old)) / 2
    near = references * exp(-gaps / jnp.maximum(reach, 1.0)[None])
    there = jax.lax.stop_gradient(before.masses[:num_old] * detection)[:, None] * exp(-gaps)
    is_dense = jnp.sum(there, axis=0) ** 2 >= _ENOUGH * jnp.sum(there**2, axis=0)
    return before.densities @ _normalised(near), is_dense & jnp.any(there > 0, axis=0)


def _kth_smallest(values: Float[Array, "n m"], k: int) -> Float[Array, " m"]:
    """The k-th smallest number of each column of numbers that are not negative, in float32.

    Bit by bit, the highest first. On a CPU `jax.lax.top_k` sorts, in 25 times as long.
    """
    bits = jax.lax.bitcast_convert_type(values.astype(jnp.float32), jnp.int32)

    def refine(place: Int[Array, ""], prefix: Int[Array, " m"]) -> Int[Array, " m"]:
        trial = prefix | (jnp.int32(1 << 30) >> place)
        num_below = jnp.sum(bits < trial[None], axis=0, dtype=jnp.int32)
        return jnp.where(num_below < k, trial, prefix)

    prefix = jax.lax.fori_loop(0, 31, refine, jnp.zeros_like(bits[0]))
    return jax.lax.bitcast_convert_type(prefix, jnp.float32)


def _references(intensity: _Intensity) -> Float[Array, " p"]:
    """The masses of all particles as draws of one newborn object, undetected ones in two halves.

    Each half counts by its objects, so that where all places are alike, so are their densities.
    """
    num_old, first = len(intensity.densities), len(intensity.references)
    is_old = jnp.arange(first) < num_old
    masses = jnp.where(intensity.references > 0, intensity.masses[:first], 0.0)
    shares = _normalised(jax.ops.segment_sum(masses, is_old.astype(jnp.int32), 2))
    references = intensity.references * jnp.where(is_old, shares[1], shares[0])
    return jnp.pad(jax.lax.stop_gradient(references), (0, len(intensity.masses) - first))


def _normalised(masses: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """The masses over their sum, or zero."""
    total = jnp.sum(masses, axis=0, keepdims=True)
    return masses / jnp.where(total > 0, total, 1.0)


def _redrawn(
    key: Key[Array, ""], masses: Float[Array, "k n"], number: int
) -> tuple[Int[Array, "k number"], Float[Array, "k number"]]:
    """So many columns of each row, drawn systematically by its masses, and an equal share of each.

    The derivative of a share is that of the mass it was drawn by, as `Resample` has it.
    """
    upto = jnp.cumsum(jax.lax.stop_gradient(masses), axis=1)
    points = jnp.arange(number, dtype=upto.dtype)[None] + uniform(key, (len(upto), 1), upto.dtype)
    points *= (1 - jnp.finfo(upto.dtype).eps) / number  # the last one is below the total
    find = jax.vmap(lambda upto, points: jnp.searchsorted(upto, points, side="right"))
    places = find(upto, points * upto[:, -1:]).astype(jnp.int32)
    places = jnp.minimum(places, masses.shape[1] - 1)
    choice = jnp.take_along_axis(masses, places, axis=1)
    equal = jnp.broadcast_to(upto[:, -1:] / number, choice.shape)
    ratios = choice / jax.lax.stop_gradient(jnp.where(choice > 0, choice, 1.0))
    return places, add_gradient(equal, equal * ratios)
