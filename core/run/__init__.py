"""Running takes: the stages in their order, the record of a run, and many takes at once."""
