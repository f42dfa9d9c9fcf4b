"""Error against evaluations and against run time, for every method on the same tasks."""

import os
import warnings

# a small solve that waits for threads of LAPACK on busy cores takes a hundred times as long
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

with warnings.catch_warnings():
    warnings.filterwarnings("ignore", "jaxlib .* can hang", RuntimeWarning)
    from smoothdiff._jaxlib import take_threads

take_threads()
