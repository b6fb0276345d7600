"""Laws beyond the linear model, one kind a file: a file that defines `EFFECT` is all that a new kind takes."""
