"""Products of arrays in the full precision of their dtype: all that the library itself computes.

By default a GPU rounds the factors of a float32 product to 10 bits (TF32) and a TPU to 7. That may
do for a network; weights, fits and steps would be wrong in the fourth digit. What the user's
function computes stays as precise as the user has set it.
"""

import jax.numpy as jnp
from jaxtyping import Array


def dot(a: Array, b: Array) -> Array:
    """The matrix product; of two vectors the inner product."""
    return jnp.matmul(a, b, precision="highest")


def combined(coefficients: Array, rows: Array) -> Array:
    """The sum of coefficients times rows, in the dtype of the rows, which may have any shape."""
    return jnp.tensordot(coefficients.astype(rows.dtype), rows, axes=1, precision="highest")
