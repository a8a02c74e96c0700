"""Poses that are known beforehand: as priors, or held, and judged by the photographs."""
