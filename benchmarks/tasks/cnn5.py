"""CNN5: the 268,773 weights of a network that says a mug's rotation, position and colour.

The mug of CNN, which is also moved to the left and right and has a colour.
"""

import jax.numpy as jnp

from benchmarks._task import Budget, Task
from benchmarks.methods import grey_box

TITLE = "CNN5: 268,773 weights of a network that sees a mug's pose and colour"
METHODS = (*grey_box.VARIANTS, "grey_gauss_newton")
SPREAD = (1.5, 1.5, 1.5, 1.5, 1.5)
SIGMA = 0.5
ASIDE = 0.4  # scene units, for a position of 1
BRIGHT, TINT = 60.0, 25.0  # of each channel of the flash, and how a colour of 1 changes it


def build(full: bool) -> Task:
    """A pose is an angle in radians, a position, and red, green and blue."""
    from benchmarks.scenes import mug, mug_network

    turned = lambda pose: mug_network.FRONT + pose[:1]
    # the camera and its flash move the other way
    aside = lambda pose: jnp.array([-ASIDE, 0.0, 0.0]) * pose[1]
    return mug_network.network_task(
        full,
        "cnn5",
        TITLE,
        {
            "handle.rotate": lambda pose: turned(pose)[0],
            "handle.translate": lambda pose: mug.move_of_handle(turned(pose)),
            "camera.translate": aside,
            "lamp.position": lambda pose: jnp.array(mug.CAMERA, jnp.float32) + aside(pose),
            "lamp.intensity.value": lambda pose: jnp.maximum(BRIGHT + TINT * pose[2:5], 0),
        },
        SPREAD,
        SIGMA,
        Budget(400_000, 3600) if full else Budget(16_000, 240),
    )
