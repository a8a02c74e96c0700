"""Ground control points, marked pixels and known lengths: models to metres by them."""
