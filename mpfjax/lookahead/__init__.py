"""Look-aheads: the information of later observations on a particle, before it is resampled."""
