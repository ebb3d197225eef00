"""The user's corrections: trajectories to remove, regions to exclude, degrees of freedom to lock or to limit."""
