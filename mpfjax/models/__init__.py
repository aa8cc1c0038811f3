"""State-space models: the interface, and the models included in the library."""
