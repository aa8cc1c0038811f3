"""How much is timed, and how large the filter is that errors are measured from."""

TIMED_PARTICLES, TIMED_FRAMES, WARM_UP = 1000, 50, 5
REFERENCE_PARTICLES, REFERENCE_RUNS = 5000, 4
