"""Ray-cast worlds with exact ground truth, for tests and benchmarks; no part of the wheel."""
