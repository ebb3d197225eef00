"""Telling Tricap what it did wrong: trajectories and regions to leave out, degrees of freedom to lock or to limit."""
