"""A run's results as native Blender data: cameras, footage, cloud, trajectories, armature, action, metaballs and skins."""
