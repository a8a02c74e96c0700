"""The folder of a run: layout, manifest, lock, keys, options, kernels and usage."""
