"""CNN: the 267,745 weights of a network that says how far a mug is turned, from its picture.

The angle is anywhere where the handle can be seen.
"""

from benchmarks._task import Budget, Task
from benchmarks.methods import grey_box

TITLE = "CNN: 267,745 weights of a network that sees a mug's rotation"
METHODS = (*grey_box.VARIANTS, "grey_gauss_newton")
SPREAD = (2.2,)  # radians, to either side
SIGMA = 0.5


def build(full: bool) -> Task:
    """A pose is the angle, 0 where the handle points at the camera."""
    from benchmarks.scenes import mug, mug_network

    turned = lambda pose: mug_network.FRONT + pose
    return mug_network.network_task(
        full,
        "cnn",
        TITLE,
        {
            "handle.rotate": lambda pose: turned(pose)[0],
            "handle.translate": lambda pose: mug.move_of_handle(turned(pose)),
        },
        SPREAD,
        SIGMA,
        Budget(400_000, 3600) if full else Budget(16_000, 240),
    )
