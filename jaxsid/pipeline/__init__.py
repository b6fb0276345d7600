"""From a model and records to everything that is identified: the stages, in the order in which they run."""
