"""Resampling within components: schemes, allocation of slots, ordering, optimal transport."""
