"""Mechanical models: lumped elements, second-order and first-order forms, sampling, modes, simulation."""
