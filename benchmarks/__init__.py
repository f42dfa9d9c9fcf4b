"""Error against evaluations and against run time, for every method on the same tasks."""
