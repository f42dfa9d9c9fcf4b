"""Host functions of black boxes, which count their calls, or fail."""

import jax
import jax.numpy as jnp
import numpy as np

from smoothdiff._black_box import black_box

SCALAR = jax.ShapeDtypeStruct((), jnp.float32)


class Counted:
    """A host function that counts its calls and the samples in them."""

    __name__ = "counted"

    def __init__(self, fun, batched=False):
        self.fun, self.batched, self.calls, self.samples = fun, batched, 0, 0

    def __call__(self, *args):
        assert all(type(leaf) is np.ndarray for leaf in jax.tree.leaves(args))
        self.calls += 1
        self.samples += len(args[0]) if self.batched else 1
        return self.fun(*args)


def stairs(x):
    return np.floor(x).sum(axis=-1)


def stairs_box(batched=False, **options):
    """The same NumPy code serves a single sample and a batch: the parameters are the last axis."""
    counted = Counted(stairs, batched)
    return black_box(counted, SCALAR, batched=batched, **options), counted


def fragile(x):
    """Fails where its parameter is negative."""
    if x.min() < 0:
        raise ValueError(f"negative roughness {x.min():.2f}")
    return np.sqrt(x).sum()


class Flaky:
    """Fails the first `failures` times that it sees a sample."""

    __name__ = "flaky"

    def __init__(self, failures):
        self.failures, self.seen = failures, {}

    def __call__(self, x):
        tries = self.seen[float(x)] = self.seen.get(float(x), 0) + 1
        if tries <= self.failures:
            raise OSError(f"licence server, try {tries}")
        return x
