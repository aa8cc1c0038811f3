"""The bins of a colour histogram."""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt8

from mpfjax.checks import Checked, Count, Share


class AbstractColours(Checked):
    """A way to sort the pixels of an RGB frame into bins, in one or more channels.

    Each channel has a normalised histogram of its own. The squared distances of the channels are
    added.
    """

    @property
    @abc.abstractmethod
    def num_channels(self) -> int:
        """How many histograms a box has."""

    @property
    @abc.abstractmethod
    def num_bins(self) -> int:
        """Bins a channel."""

    @abc.abstractmethod
    def bins(self, frame: UInt8[Any, "h w 3"]) -> Int[Any, "h w channels"]:
        """The bin of each pixel in each channel, in [0, num_bins)."""


class RGBColours(AbstractColours):
    """Red, green and blue separately, each in `num_bins` equal bins.

    Vermaak et al. (2003), section 5.2. Raises `ValueError` for a number of bins below 1.
    """

    num_bins: Count = eqx.field(static=True, default=30)

    @property
    def num_channels(self) -> int:
        """3."""
        return 3

    def bins(self, frame: UInt8[Any, "h w 3"]) -> Int[Any, "h w 3"]:
        """Red, green and blue in steps of 256 / num_bins."""
        return frame.astype(jnp.int32) * self.num_bins // 256


class HSVColours(AbstractColours):
    """Hue and saturation jointly, and the value of pixels with little colour.

    N = N_h N_s + N_v bins in one histogram, Lin et al. (2012), section 2.1, after Pérez, Hue,
    Vermaak and Gangnet (2002). A pixel with a saturation of at least `least_saturation` and a value
    of at least `least_value` (both in [0, 1]) is counted in one of N_h N_s bins of hue and
    saturation. The hue of any other pixel is unreliable: the pixel is counted in one of N_v bins of
    value. Use it if the illumination changes, or if one histogram should replace three.

    Raises `ValueError` for a number of bins below 1 and thresholds outside [0, 1].
    """

    num_hues: Count = eqx.field(static=True, default=10, kw_only=True)
    num_saturations: Count = eqx.field(static=True, default=10, kw_only=True)
    num_values: Count = eqx.field(static=True, default=10, kw_only=True)
    least_saturation: Share = eqx.field(static=True, default=0.1, kw_only=True)
    least_value: Share = eqx.field(static=True, default=0.2, kw_only=True)

    @property
    def num_channels(self) -> int:
        """1."""
        return 1

    @property
    def num_bins(self) -> int:
        """N = N_h N_s + N_v."""
        return self.num_hues * self.num_saturations + self.num_values

    def bins(self, frame: UInt8[Any, "h w 3"]) -> Int[Any, "h w 1"]:
        """Hue N_s + saturation if there is colour, N_h N_s + value otherwise."""
        hue, saturation, value = hue_saturation_value(frame)
        coloured = (saturation >= self.least_saturation) & (value >= self.least_value)
        colour = _bin(hue, self.num_hues) * self.num_saturations
        colour += _bin(saturation, self.num_saturations)
        grey = self.num_hues * self.num_saturations + _bin(value, self.num_values)
        return _numpy_of(frame).where(coloured, colour, grey)[:, :, None]


def _numpy_of(frame: Any) -> Any:
    """NumPy for its own arrays, JAX's for others."""
    return np if isinstance(frame, np.ndarray) else jnp


def hue_saturation_value(
    frame: UInt8[Any, "h w 3"],
) -> tuple[Float[Any, "h w"], Float[Any, "h w"], Float[Any, "h w"]]:
    """Hue, saturation and value of each pixel in [0, 1], by the usual hexcone.

    Hue runs from red at 0 through green at 1/3 and blue at 2/3; it is 0 where there is no colour.
    By NumPy where the frame is an array of it, without compiling anything.
    """
    xp = _numpy_of(frame)
    red, green, blue = (frame[:, :, i].astype(xp.float32) for i in range(3))
    high = xp.maximum(xp.maximum(red, green), blue)
    chroma = high - xp.minimum(xp.minimum(red, green), blue)
    unit = xp.where(chroma > 0, chroma, 1.0)
    from_red = (green - blue) / unit
    sector = xp.where(
        high == red,
        xp.where(from_red < 0, from_red + 6, from_red),
        xp.where(high == green, (blue - red) / unit + 2, (red - green) / unit + 4),
    )
    hue = xp.where(chroma > 0, sector / 6, 0.0)
    saturation = chroma / xp.where(high > 0, high, 1.0)
    return hue, saturation, high / 255


def _bin(share: Float[Any, "h w"], num_bins: int) -> Int[Any, "h w"]:
    return (share * num_bins).astype(jnp.int32).clip(0, num_bins - 1)
