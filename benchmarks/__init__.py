"""Error against evaluations and against run time, for every method on the same tasks."""

import os

# a small solve that waits for threads of LAPACK on busy cores takes a hundred times as long
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
