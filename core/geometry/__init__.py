"""Cameras, rays and points in space."""
