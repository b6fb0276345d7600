"""Where a model and the records part: noise, size of the gap, its place."""
