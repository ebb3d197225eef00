"""Recordings with known truth: a textured arm that moves before three cameras, and the scoring of a run against it."""
