"""Calibration in Blender: a waved bar's footage in, cameras with footage out; other tools' rigs in and out."""
