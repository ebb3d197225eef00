"""Clicking joints and surface seeds in the Clip Editor."""
