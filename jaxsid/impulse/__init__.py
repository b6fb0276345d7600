"""Impulse responses (Markov parameters) from records: one estimator a file, one signature for all."""
