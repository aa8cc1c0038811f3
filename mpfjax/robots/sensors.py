"""Laser scanners: p(scan | pose, map), by distances to walls or by ranges along beams."""

import abc
from typing import Annotated, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, Bool, Float

from mpfjax.arrays import NOT_NEGATIVE, POSITIVE, Fitting, to_array, to_numbers
from mpfjax.checks import Count, Exponent, NotNegative, Positive, check_shape, entries, warn
from mpfjax.models.gaussians import log_normal
from mpfjax.operations.stored import stored
from mpfjax.robots.maps import Angles, Beams, OccupancyGrid, Poses, ends_of

Weight = Annotated[Float[Array, ""], NOT_NEGATIVE]
Scale = Annotated[Float[Array, ""], POSITIVE]

# The independent beams that a scan is worth, whatever their number, and those beyond which a
# scan is too sharp for the particles of a filter.
_INDEPENDENT, _SHARP = 10, 30
_TURN = 2 * np.pi + 0.01
_WHAT = "finite and within ±2π, in radians: np.deg2rad(...)"
RADIANS = entries(lambda angles: np.abs(angles) <= _TURN, _WHAT)
# A pose: x and y are any numbers.
POSE = entries(
    lambda pose: np.isfinite(pose).all() and abs(pose[-1]) <= _TURN,
    "a pose, finite, whose heading is within ±2π, in radians: np.deg2rad(...)",
)


class AbstractLaser(Fitting):
    """A planar scanner: p(scan | pose, map) is the product over its beams, raised to a power.

    - `angles`: of the beams of a scan, (k,), relative to the scanner's heading: `angle_min +
      angle_increment * arange(k)` of ROS's `LaserScan`, in radians.
    - `laser_max_range`: metres; a beam of at least this range, or an infinite one, hit nothing.
    - `laser_min_range`: metres; a beam up to this range counts as one that hit nothing, as in AMCL.
    - `max_beams`: how many are used, evenly spaced among the informative ones.
    - `exponent`: the power. Beams share the errors of the map and of the pose, so that their
      product is far too narrow. None is 10 over the number of beams that are used, at most 1: a
      scan is then worth ten independent beams.
    - `mount`: pose of the scanner in the robot's frame.
    - `z_hit`, `z_rand`: weights of a beam that ends where the map predicts, and of a uniform range;
      all weights are divided by their sum.
    - `sigma_hit`: the standard deviation of the first in metres.

    A scan is (k,), in metres; beams that are NaN are ignored, and so are those of -inf, which hit
    something too near to be measured (REP 117). Raises `ValueError` for angles beyond ±2π, and
    warns if an exponent makes a scan worth more than thirty independent beams: few particles of a
    diffuse prior survive it.
    """

    angles: Annotated[Float[Array, " k"], RADIANS] = eqx.field(converter=to_array("angles"))
    laser_max_range: Positive = eqx.field(static=True, kw_only=True)
    laser_min_range: NotNegative = eqx.field(static=True, kw_only=True, default=0.0)
    max_beams: Count = eqx.field(static=True, kw_only=True, default=60)
    exponent: Exponent | None = eqx.field(static=True, kw_only=True, default=None)
    mount: Annotated[tuple[float, ...], POSE] = eqx.field(
        static=True, kw_only=True, converter=to_numbers("mount"), default=(0.0, 0.0, 0.0)
    )
    z_hit: Weight = eqx.field(kw_only=True, converter=to_array("z_hit"), default=0.5)
    z_rand: Weight = eqx.field(kw_only=True, converter=to_array("z_rand"), default=0.5)
    sigma_hit: Scale = eqx.field(kw_only=True, converter=to_array("sigma_hit"), default=0.2)

    def __check_init__(self) -> None:
        super().__check_init__()
        worth = (self.exponent or 0.0) * min(self.max_beams, len(self.angles))
        if worth > _SHARP:
            what = f"a scan is worth {worth:.3g} independent beams, and beams share errors"
            warn(f"exponent: with {self.exponent:g} {what}; None is worth {_INDEPENDENT}")

    def log_likelihood(
        self, scan: Float[Array, " k"], poses: Poses, grid: OccupancyGrid
    ) -> Float[Array, " n"]:
        """log p of a scan at each pose of the robot, up to a constant."""
        check_shape(str(len(self.angles)), observation=scan)
        met = (scan > self.laser_min_range) & (scan < self.laser_max_range)
        usable = self.usable(scan, met)
        angles, scan, met, is_used = self._space_out(usable, self.angles, scan, met)
        forward, left, turn = self.mount
        cos, sin = jnp.cos(poses[:, 2]), jnp.sin(poses[:, 2])
        steps = [cos * forward - sin * left, sin * forward + cos * left, jnp.full_like(cos, turn)]
        ranges = jnp.where(met, scan, self.laser_max_range)
        logs = self.log_beams(ranges, stored(poses.T + jnp.stack(steps)).T, angles, grid)
        return self.log_scan(jnp.where(is_used[None], logs, -jnp.inf), is_used)

    def usable(self, scan: Float[Array, " k"], met: Bool[Array, " k"]) -> Bool[Array, " k"]:
        """Which beams are informative."""
        return ~jnp.isnan(scan) & (scan != -jnp.inf)

    def log_scan(self, logs: Beams, is_used: Bool[Array, " b"]) -> Float[Array, " n"]:
        """log p of the scan, from the log p of its beams; beams that are not used have -inf."""
        total = jnp.sum(jnp.where(is_used[None], logs, 0.0), axis=1)
        if self.exponent is not None:
            return self.exponent * total
        number = jnp.maximum(jnp.sum(is_used).astype(total.dtype), 1.0)
        return jnp.minimum(1.0, _INDEPENDENT / number) * total

    def _space_out(self, usable: Bool[Array, " k"], *values: Array) -> list[Array]:
        """The values of at most `max_beams` usable beams, evenly spaced, and which are any."""
        most = min(self.max_beams, len(self.angles))
        if most == len(self.angles):
            return [*values, usable]
        upto, rank = jnp.cumsum(usable, dtype=jnp.int32), jnp.arange(most, dtype=jnp.int32)
        gap = (upto[-1].astype(float) - 1) / max(most - 1, 1)
        even_ranks = jnp.round(rank.astype(float) * gap).astype(jnp.int32)
        ranks = jnp.where(upto[-1] > most, even_ranks, rank)
        at = jnp.clip(jnp.searchsorted(upto, ranks + 1), 0, len(self.angles) - 1)
        return [*(value[at] for value in values), rank < upto[-1]]

    @abc.abstractmethod
    def log_beams(self, ranges: Angles, poses: Poses, angles: Angles, grid: OccupancyGrid) -> Beams:
        """log p of each beam from each pose of the scanner, maximal for one that hit nothing."""


class LikelihoodField(AbstractLaser):
    """Beams end near a wall: Thrun, Burgard and Fox (2005), table 6.3.

        p = z_hit N(d; 0, sigma_hit²) + z_rand / laser_max_range

    with d the distance from the end of the beam to the nearest edge of a wall, but at most
    `laser_likelihood_max_dist`, which is also used off the map. Beams that hit nothing are not
    informative, and others are used instead.

    - `weighting`: "product" of p to the power `exponent`, or AMCL's "cubes": 1 + Σ p³, without the
      factor 1 / (sigma_hit √(2π)) and the sum of the weights. Cubes are not a likelihood: a scan
      then hardly distinguishes poses, and mixture weights are not probabilities.

    It is smooth, and takes one look-up per beam: use it first. `AbstractLaser` describes the other
    parameters. It ignores that a beam cannot pass through a wall.
    """

    laser_likelihood_max_dist: Positive = eqx.field(static=True, kw_only=True, default=2.0)
    weighting: Literal["product", "cubes"] = eqx.field(static=True, kw_only=True, default="product")

    def usable(self, scan: Float[Array, " k"], met: Bool[Array, " k"]) -> Bool[Array, " k"]:
        """Which beams hit anything."""
        return met

    def log_beams(self, ranges: Angles, poses: Poses, angles: Angles, grid: OccupancyGrid) -> Beams:
        """By the distance of each beam's end to the nearest edge of a wall."""
        gaps = grid.at(ends_of(poses, angles, ranges[None]), grid.distances, jnp.inf)
        # Stored, since XLA uses no vectors for what it fuses with a look-up.
        gaps = stored(jnp.minimum(gaps, self.laser_likelihood_max_dist))
        hit = jnp.exp(log_normal(gaps, self.sigma_hit))
        rest, total = self.z_rand / self.laser_max_range, self.z_hit + self.z_rand
        if self.weighting == "cubes":
            hit, total = hit * self.sigma_hit * np.sqrt(2 * np.pi), 1.0
        return jnp.log((self.z_hit * hit + rest) / total)

    def log_scan(self, logs: Beams, is_used: Bool[Array, " b"]) -> Float[Array, " n"]:
        """log p of the scan, by the weighting."""
        if self.weighting == "product":
            return super().log_scan(logs, is_used)
        return jnp.log1p(jnp.sum(jnp.exp(3 * logs), axis=1))


class BeamModel(AbstractLaser):
    """Beams end at the first wall: Thrun, Burgard and Fox (2005), table 6.1.

        p = z_hit N(z; z*, sigma_hit²) + z_short lambda_short exp(-lambda_short z) 1(z <= z*)
            + z_max 1(z = laser_max_range) + z_rand / laser_max_range 1(z < laser_max_range)

    with z* the range that the map predicts, and the first two normalised on [0, laser_max_range]
    and [0, z*]. `z_short` is the weight of obstacles in front of the wall, such as people, and
    `z_max` the weight of beams that hit nothing. `AbstractLaser` describes the other parameters.

    Use it if several poses have walls at the same distances, but in other directions, or behind
    other walls, with a map that is `tabulated`: it then takes no longer than `LikelihoodField`.
    """

    z_short: Weight = eqx.field(kw_only=True, converter=to_array("z_short"), default=0.005)
    z_max: Weight = eqx.field(kw_only=True, converter=to_array("z_max"), default=0.05)
    lambda_short: Scale = eqx.field(kw_only=True, converter=to_array("lambda_short"), default=0.1)

    def log_beams(self, ranges: Angles, poses: Poses, angles: Angles, grid: OccupancyGrid) -> Beams:
        """By the range to the first occupied cell."""
        most = self.laser_max_range
        expected = stored(grid.ranges(poses, angles, most))
        inside = ndtr((most - expected) / self.sigma_hit) - ndtr(-expected / self.sigma_hit)
        hit = jnp.exp(log_normal(ranges[None] - expected, self.sigma_hit)) / inside
        rate, wall = self.lambda_short, jnp.maximum(expected, grid.resolution / 2)
        short = rate * jnp.exp(-rate * ranges)[None] / -jnp.expm1(-rate * wall)
        of_map = self.z_hit * hit + self.z_short * jnp.where(ranges[None] <= expected, short, 0.0)
        density = of_map + jnp.where(ranges < most, self.z_rand / most, self.z_max)[None]
        return jnp.log(density / (self.z_hit + self.z_short + self.z_max + self.z_rand))
