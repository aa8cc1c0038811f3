"""State-space models: the interface, and the models that ship with the library."""
