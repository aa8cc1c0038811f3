"""Look-aheads: what later observations say of a particle, before it is resampled or moved."""
