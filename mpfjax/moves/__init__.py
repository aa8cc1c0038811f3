"""The moves that make up a filter: regrouping, resampling, propagating."""
