"""The colour model of Vermaak et al. (2003), section 5.2, and Lin et al. (2012), section 2."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, UInt8

from mpfjax.checks import Count, NotNegative, Positive, Renamed, Share, checked, shown
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.models.dynamics import AbstractDynamics, RandomWalk
from mpfjax.operations.random import fast_key
from mpfjax.vision import colour
from mpfjax.vision.files.boxes import check_boxes, to_centre
from mpfjax.vision.files.frames import check_frame

Seen = colour.IntegralHistogram | UInt8[Array, "h w 3"]
PAPER_VARIANCES = (2.5, 1.5, 0.05, 0.05)


class BoxState(eqx.Module):
    """The position and size of a box, and the reference box with which it is compared.

    - `box`: (x, y, s_x, s_y), the centre in pixels and the size in units of the reference box.
    - `reference`: r, the index of the reference box, in [0, number of references).
    - `previous`: the memory of second-order dynamics, as returned by their `remembered`: the box
      one frame before.
    - `appearance`: the histograms that a `LearnedColourModel` has learned, (n, parts, channels,
      bins); None for other models.
    """

    box: Float[Array, "*n 4"]
    reference: Int[Array, "*n"]
    previous: Float[Array, "*n 4"] | None = None
    appearance: Float[Array, "*n parts channels bins"] | None = None


class ColourModel(AbstractStateSpaceModel):
    """Boxes that move at random and are recognised by the colours in them.

    Vermaak et al. (2003), section 5.2: (x, y, s_x, s_y) follow independent Gaussian random walks,
    and

        L(y | x) ∝ exp(-Σ_c B²(h^c, h_ref^c) / 2σ²)

    where B is the Bhattacharyya distance of the normalised histograms of the colours c = R, G, B in
    the hypothesised and in the reference box. Lin et al. (2012), section 2, is the same with one
    `HSVColours` histogram (eqs. 1 to 3) and an `Autoregression` (eq. 4). Two extensions are in
    neither paper, and off by default:

    - several references: r, the reference with which a particle is compared, is part of the state,
      so that the recursion remains exact. x_0 is distributed equally over all references. r never
      changes, or is redrawn with a small probability in every frame, for objects that change their
      appearance;
    - boxes divided into bands from top to bottom, whose B² are averaged, so that a shirt is not
      confused with trousers; and weights of colours: a colour has more weight the larger its share
      in a reference box is, compared with the surroundings of the box. Grass in a box then has
      little weight.

    An observation is an RGB frame, uint8 of shape (h, w, 3), or its `IntegralHistogram`. A box
    outside the frame has no colour and the largest distance, B = 1. So has a box of more pixels
    than can be counted, see `wide_counts`. Make a model with `from_frame`. Use it for objects that
    keep their colours and are not surrounded by the same colours.

    - `reference_boxes`: (k, 4), centre and size in pixels; x_0 is Gaussian about them.
    - `references`, `colour_weights`: h_ref and the weights of its colours, (k, parts, channels,
      bins).
    - `dynamics`: of (x, y, s_x, s_y), in pixels for x and y and in units of the reference box for
      s_x and s_y; its parameters have a leading axis k.
    - `initial_deviations`: standard deviations of x_0, (k, 4), in the same units.
    - `sigma`: σ, the width of the likelihood.
    - `colours`: the bins of the histograms.
    - `switch_probability`: the probability, in each frame, that r is redrawn from all references.
    - `contrast`: how much the log-likelihood increases if the areas at both sides of a box, half a
      width each, do not have the reference's colours. 0 uses only the box, as in the paper. A box
      that is too large to be counted together with its sides has no increase.
    - `wide_counts`: count pixels in 32 bits; see `integral_histogram`. Without it, a box, or with
      `contrast` a box with its sides, may have at most 65 535 pixels.
    """

    reference_boxes: Float[Array, "k 4"]
    references: Float[Array, "k parts channels bins"]
    colour_weights: Float[Array, "k parts channels bins"]
    dynamics: AbstractDynamics
    initial_deviations: Float[Array, "k 4"]
    sigma: Float[Array, ""]
    colours: colour.Colours
    switch_probability: Share = eqx.field(static=True)
    contrast: NotNegative = eqx.field(static=True)
    wide_counts: bool = eqx.field(static=True)

    @classmethod
    @checked
    def from_frame(
        cls,
        frame: UInt8[np.ndarray, "h w 3"],
        boxes: Float[np.ndarray, "k 4"],
        *,
        colours: colour.Colours | None = None,
        sigma: Positive = 0.15,
        deviations: Float[np.ndarray, "..."] | None = None,
        dynamics: AbstractDynamics | None = None,
        num_parts: Count = 1,
        weigh_colours: bool = False,
    ) -> "ColourModel":
        """The model whose references are boxes (x, y, w, h), top-left corner first, of a frame.

        - `colours`: the bins of the histograms; None is `RGBColours()`.
        - `deviations`: standard deviations of x_0 and of the random walk, (4,) or one row per box;
          None is the paper's, the roots of (2.5, 1.5, 0.05, 0.05).
        - `dynamics`: instead of the random walk; one for all boxes, or with a row for each.
        - `num_parts`: bands from top to bottom.
        - `weigh_colours`: weight each colour by its share in the box relative to its share in the
          surroundings, a box of twice the width and height.

        `switch_probability` and `contrast` are 0; `dataclasses.replace` changes them.

        Raises `ValueError`, with the name of the argument, for an argument of another kind, for a
        frame that is not (h, w, 3) of type uint8, for a box without area or outside the frame, and
        for a number that is not positive.
        """
        check_frame(frame)
        boxes = check_boxes(boxes, *frame.shape[:2])
        colours = colour.RGBColours() if colours is None else colours
        deviations = np.sqrt(PAPER_VARIANCES) if deviations is None else deviations
        steps = jnp.asarray(positive_deviations(deviations, len(boxes)), float)
        steps = jnp.broadcast_to(steps, (len(boxes), 4))
        places = jnp.asarray(to_centre(boxes), float)
        # Room for boxes, with their sides, to grow to twice the area of the largest reference.
        room = 2 * colour.SURROUND * np.prod(boxes[:, 2:] + 1, axis=1).max()
        wide_counts = bool(room > colour.LARGEST_NARROW)
        table = colour.integral_histogram(jnp.asarray(frame), colours, wide_counts)
        references, weights = colour.reference_histograms(table, places, num_parts, weigh_colours)
        return cls(
            reference_boxes=places,
            references=references,
            colour_weights=weights,
            dynamics=_for_each(RandomWalk(steps) if dynamics is None else dynamics, len(boxes)),
            initial_deviations=steps,
            sigma=jnp.asarray(sigma, float),
            colours=colours,
            switch_probability=0.0,
            contrast=0.0,
            wide_counts=wide_counts,
        )

    def sample_initial(self, key: Key[Array, ""], num_particles: int) -> BoxState:
        """x_0 about the reference boxes, equally many for each, at scale one."""
        k = self.reference_boxes.shape[0]
        key_offset, key_noise = jax.random.split(key)
        offset = jax.random.randint(key_offset, (), 0, num_particles)
        reference = (jnp.arange(num_particles) * k + offset) // num_particles % k
        centre = self.reference_boxes.at[:, 2:].set(1.0)
        noise = jax.random.normal(key_noise, (num_particles, 4), centre.dtype)
        box = centre[reference] + self.initial_deviations[reference] * noise
        states = BoxState(box, reference)
        past = self.dynamics_of(states).initial_past(jax.random.fold_in(key_noise, 1), box)
        return BoxState(box, reference, past)

    def sample_transition(self, key: Key[Array, ""], states: BoxState) -> BoxState:
        """x_t from the dynamics; with the switch probability, r is drawn again."""
        key_noise, key_switch, key_reference = jax.random.split(fast_key(key), 3)
        reference = states.reference
        if self.switch_probability > 0:
            k = self.reference_boxes.shape[0]
            switches = jax.random.bernoulli(key_switch, self.switch_probability, reference.shape)
            drawn = jax.random.randint(key_reference, reference.shape, 0, k, reference.dtype)
            reference = jnp.where(switches, drawn, reference)
        box = self.dynamics_of(states).sample(key_noise, states.box, states.previous)
        return self.with_history(BoxState(box, reference, None, states.appearance), states)

    def log_transition(self, states: BoxState, previous_states: BoxState) -> Float[Array, " n"]:
        """log D(x_t | x_{t-1}) + log P(r_t | r_{t-1}), -inf where r cannot have changed."""
        dynamics, current = self.dynamics_of(previous_states), previous_states.box
        log_density = dynamics.log_density(states.box, current, previous_states.previous)
        drawn = self.switch_probability / self.reference_boxes.shape[0]
        stays = states.reference == previous_states.reference
        probability = jnp.where(stays, 1 - self.switch_probability + drawn, drawn)
        return log_density + jnp.log(probability.astype(states.box.dtype))

    def with_history(self, states: BoxState, previous_states: BoxState) -> BoxState:
        """The states as offspring of the previous ones, whose boxes they remember."""
        dynamics = self.dynamics_of(previous_states)
        past = dynamics.remembered(states.box, previous_states.box, previous_states.previous)
        return BoxState(states.box, states.reference, past, states.appearance)

    def dynamics_of(self, states: BoxState) -> AbstractDynamics:
        """The dynamics of each particle's own reference."""
        return jax.tree.map(lambda leaf: leaf[states.reference], self.dynamics)

    def boxes(self, states: BoxState) -> Float[Array, "n 4"]:
        """(x, y, s_x l_x, s_y l_y): the hypothesised boxes, centre and size in pixels."""
        size = self.reference_boxes[states.reference, 2:]
        return jnp.concatenate([states.box[:, :2], states.box[:, 2:] * size], axis=1)

    def log_likelihood(self, observation: Seen, states: BoxState) -> Float[Array, " n"]:
        """-(Σ_c B² - contrast Σ_c B²_around) / 2σ², each B² averaged over the bands."""
        counts, sides = self.counts(observation, states)
        distances = self.distances(counts, sides, *self.references_of(states))
        return -0.5 * distances / self.sigma**2

    def prepare_observation(self, observation: Seen) -> colour.IntegralHistogram:
        """The frame's integral histogram; a model of several objects computes it only once."""
        if isinstance(observation, colour.IntegralHistogram):
            return observation
        return colour.integral_histogram(observation, self.colours, self.wide_counts)

    def counts(
        self, observation: Seen, states: BoxState
    ) -> tuple[colour.Histograms, colour.Histograms | None]:
        """Pixels of each colour in each box, and at its sides if `contrast` is positive."""
        num_parts = self.references.shape[1]
        observation, boxes = self.prepare_observation(observation), self.boxes(states)
        counts = observation.counts(boxes, num_parts)
        if self.contrast == 0:
            return counts, None
        wide = boxes * jnp.array([[1.0, 1.0, colour.SURROUND, 1.0]], boxes.dtype)
        return counts, observation.counts(wide, num_parts) - counts

    def distances(
        self,
        counts: colour.Histograms,
        sides: colour.Histograms | None,
        weights: colour.Histograms,
        references: colour.Histograms,
    ) -> Float[Array, " n"]:
        """Σ_c B² - contrast Σ_c B²_around of boxes with these counts, from these references."""
        distances = _distances(counts, weights, references)
        if sides is None:
            return distances
        uncounted = jnp.isnan(sides[:, 0, 0, 0])
        around = jnp.where(uncounted, 0.0, _distances(sides, weights, references))
        return distances - self.contrast * around

    own = Renamed("own", "references_of")

    def references_of(self, states: BoxState) -> tuple[colour.Histograms, colour.Histograms]:
        """The weights of colours and the references of the particles."""
        weights, references = self.colour_weights, self.references
        # With one reference, a gather costs more than the distance. Under vmap, where
        # each particle has a model of its own, the two gathers fuse.
        if references.shape[0] > 1 or states.box.shape[0] == 1:
            weights, references = weights[states.reference], references[states.reference]
        return weights, references


def _distances(
    counts: colour.Histograms, weights: colour.Histograms, references: colour.Histograms
) -> Float[Array, " n"]:
    """Σ_c B² of counted colours from references, averaged over the bands."""
    histograms = colour.normalise(counts, weights)
    distances = colour.bhattacharyya(histograms, jnp.broadcast_to(references, histograms.shape))
    return jnp.mean(jnp.sum(distances, axis=2), axis=1)


def positive_deviations(deviations: Any, num_boxes: int) -> np.ndarray:
    """Four positive numbers, for all boxes or a row for each, or a `ValueError`."""
    numbers = np.asarray(deviations, float)
    fits = numbers.shape in ((4,), (num_boxes, 4))
    if not fits or not np.all((numbers > 0) & np.isfinite(numbers)):
        raise ValueError(f"deviations: {shown(deviations)} are not four positive numbers a box")
    return numbers


def _for_each(dynamics: AbstractDynamics, num_boxes: int) -> AbstractDynamics:
    """The dynamics with a row of parameters for each box."""
    if dynamics.is_shared:
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num_boxes, *leaf.shape)), dynamics)
    rows = {leaf.shape[0] for leaf in jax.tree.leaves(dynamics)}
    if rows != {num_boxes}:
        raise ValueError(f"dynamics: parameters for {rows} boxes, not for {num_boxes}")
    return dynamics
