"""Retargeting: a motion onto any rig, and its export to other programs."""
