"""A model tried out before it is run."""
