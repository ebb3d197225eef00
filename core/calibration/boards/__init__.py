"""Cameras from a chessboard or a ChArUco board."""
