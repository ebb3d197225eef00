"""The pure core of Tricap: photogrammetry of a moving person. No bpy, no printing, no global state."""
