"""Files of arrays and states, and the identity of the run to which they belong."""
