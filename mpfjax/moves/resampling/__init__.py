"""Resampling within components: particles in line, ancestors by scheme, allocation of slots."""
