"""How noise spreads: first-order covariance of whatever is computed from an impulse response, and ensembles."""
