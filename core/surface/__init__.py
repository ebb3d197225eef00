"""The measured surface: clouds of points with normals and covariances."""
