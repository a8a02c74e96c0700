"""Plain arrays: reconstructions, tracks, rigs, features and meshes."""
