"""Retargeting in Blender: armatures read into plain values, results written as actions, files opened and saved."""
