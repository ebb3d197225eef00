"""Fitting the body to what was measured."""
