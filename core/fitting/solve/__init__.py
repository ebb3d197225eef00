"""The least squares problem of the fit, and its solution."""
