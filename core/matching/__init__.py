"""Adaptive least squares matching, seeds and the growth of a dense field of matches."""
