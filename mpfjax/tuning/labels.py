"""Likelihoods tuned on labels: the posterior of the label among candidate states."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float, Key, PyTree

from mpfjax.checks import Count, checked
from mpfjax.models.base import AbstractStateSpaceModel
from mpfjax.models.law import law_of


class LabelLikelihood(eqx.Module):
    """The conditional log likelihood of labels given their observations, for `maximise`.

    Use it for a likelihood that is not normalised over y, such as exp(-λ B²), on frames whose true
    states are known. The marginal likelihood of a filter always increases as λ decreases and has no
    maximum in λ; this objective has one.

    - `observations`: leading axis t.
    - `labels`: the true states: leaves (t, k, ...), k of them in each frame.
    - `candidates`: alternative states for each: leaves (t, k, n, ...), such as
      `transition_candidates`.
    """

    observations: PyTree
    labels: PyTree
    candidates: PyTree

    def __call__(self, key: Key[Array, ""], model: AbstractStateSpaceModel) -> Float[Array, ""]:
        """The mean over labels, in nats; at most log(n + 1)."""
        del key
        return jnp.mean(self.log_posteriors(model))

    def log_posteriors(self, model: AbstractStateSpaceModel) -> Float[Array, "t k"]:
        """log p(x* | y) / q(x*) of every label, by Monte Carlo over its candidates.

        With candidates x_1..x_n ~ q, the prior from which they are drawn, and x_0 = x* the label,

            log L(y | x*) - log (1 / (n + 1)) Σ_{i=0..n} L(y | x_i),

        is the log posterior density of the label relative to q. It is normalised over the state, so
        a factor of L that does not depend on the state cancels: conditional maximum likelihood (for
        tracking, Taycher, Demirdjian, Darrell and Shakhnarovich 2006). With the label in the sum it
        is at most log(n + 1), and its mean over labels is a lower bound of the mutual information
        of y and x* (van den Oord, Li and Vinyals 2018). If labels are accurate to a pixel only, the
        best likelihood is about a pixel wide: λ has a finite best value.

        Frames are processed one after the other and recomputed for the derivative, so only the data
        grow with t in memory.
        """

        @jax.checkpoint
        def of_frame(data: tuple[PyTree, PyTree, PyTree]) -> Float[Array, " k"]:
            observation, label, rivals = data
            first = jax.tree.map(lambda leaf: leaf[:, None], label)
            states = jax.tree.map(lambda *both: jnp.concatenate(both, axis=1), first, rivals)
            k, n = jax.tree.leaves(states)[0].shape[:2]
            flat = jax.tree.map(lambda leaf: leaf.reshape(k * n, *leaf.shape[2:]), states)
            logs = law_of(model).log_likelihood(observation, flat).reshape(k, n)
            return logs[:, 0] - logsumexp(logs, axis=1) + jnp.log(jnp.asarray(n, logs.dtype))

        return jax.lax.map(of_frame, (self.observations, self.labels, self.candidates))


@checked
def transition_candidates(
    key: Key[Array, ""], model: AbstractStateSpaceModel, labels: PyTree, num_candidates: Count
) -> PyTree:
    """Draws from D(. | the label one frame before), for every frame but the first.

    `labels` has leaves (t, k, ...), the result (t - 1, k, n, ...): alternatives that a filter would
    meet. Raises `ValueError` for fewer than one candidate.
    """
    t, k = jax.tree.leaves(labels)[0].shape[:2]
    lead = (t - 1, k, num_candidates)
    before = jax.tree.map(
        lambda leaf: jnp.repeat(leaf[:-1].reshape((t - 1) * k, *leaf.shape[2:]), lead[2], axis=0),
        labels,
    )
    drawn = law_of(model).move(key, before)
    return jax.tree.map(lambda leaf: leaf.reshape(*lead, *leaf.shape[1:]), drawn)
