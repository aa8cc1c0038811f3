"""Resampling within components: order of particles, ancestors by scheme, allocation of slots."""
