"""The skin: a mesh around the metaballs."""
