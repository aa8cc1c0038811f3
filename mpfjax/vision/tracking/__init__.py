"""The object tracker: a chain of moves on a mixture with a component for each object."""
