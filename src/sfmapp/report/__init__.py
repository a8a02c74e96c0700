"""Results as pages, pictures and JSON."""
