"""What is kept in files: arrays, states, and the identity of the run that they are of."""
