"""Running a filter: over observations, seeds, devices, processes, islands, and whole studies."""
