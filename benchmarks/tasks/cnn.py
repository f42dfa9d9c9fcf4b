"""A network that looks at pictures of a mug and says its pose, trained through the renderer.

After CNN and CNN5 of higher-order differentiable rendering (section 4.1), with as many weights:
three convolutions of 16 channels, 256 units, and the pose. Nobody tells the network the poses of
its training pictures. It is given a picture, a mug in the pose that it says is rendered, and the
loss is how much that differs from the picture. The pose is an angle anywhere where the handle can
be seen; of `cnn5` also a position to the left or right, and a colour.

Left out: Mitsuba need not move the mug, which is round but for its handle. The camera and its flash
move sideways instead, and the colour of the mug is that of the flash, as nothing else is lit. The
noise of all pictures is the same, so the right pose has no loss.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from benchmarks._task import Effort, Grey, Problem, Score, Task, entry
from benchmarks.scenes.mitsuba_scene import Params, picture
from benchmarks.scenes.networks import last_layer
from benchmarks.tasks import mug

POSE_SIGMA = 0.5  # the scale of a pose
SIGMA, BOUND = 0.025, 50.0  # of the weights, for methods that know of nothing else
CHANNELS, GRID, UNITS = 16, 8, 256
SPP, SCORE_SPP = 4, 16  # samples per pixel, and those of pictures by which a network is judged
SHOWN = 6  # pictures of those that were not trained on

ASIDE = 0.4  # scene units, for a position of 1
BRIGHT, TINT = 60.0, 25.0  # of each channel of the flash, and how a colour of 1 changes it


class Network(eqx.Module):
    """Convolutions with pooling down to 8 x 8, and two layers."""

    convolutions: list[eqx.nn.Conv2d]
    layers: list[eqx.nn.Linear]

    def __init__(self, outputs: int, key: Array):
        keys = iter(jax.random.split(key, 5))
        channels = ((3, CHANNELS), (CHANNELS, CHANNELS), (CHANNELS, CHANNELS))
        self.convolutions = [eqx.nn.Conv2d(*c, 3, padding=1, key=next(keys)) for c in channels]
        sizes = ((CHANNELS * GRID**2, UNITS), (UNITS, outputs))
        self.layers = [eqx.nn.Linear(*s, key=next(keys)) for s in sizes]

    def hidden(self, seen: Float[Array, "size size 3"]) -> Float[Array, "units"]:
        """What the last layer sees. Channels stay last, as that takes half of the time."""
        x = seen
        for convolution in self.convolutions:
            x = jax.lax.conv_general_dilated(
                *(x[None], convolution.weight, (1, 1), "SAME"),
                dimension_numbers=("NHWC", "OIHW", "NHWC"),
            )[0]
            assert convolution.bias is not None
            x += convolution.bias.reshape(1, 1, CHANNELS)
            if len(x) > GRID:
                x = x.reshape(len(x) // 2, 2, len(x) // 2, 2, CHANNELS).max((1, 3))
            x = jax.nn.relu(x)
        return jax.nn.relu(self.layers[0](x.ravel()))

    def __call__(self, seen: Float[Array, "size size 3"]) -> Float[Array, "outputs"]:
        """The pose."""
        return self.layers[1](self.hidden(seen))


def network_task(
    full: bool,
    params: Params,
    spread: tuple[float, ...],
    data: int = 0,
    others: int | None = None,
    **named: Any,
) -> Task:
    """The task of training the network. Its weights are y.

    Quick: 32 x 32 pixels, 256 pictures to train on; full: 64 x 64 and 1,024. With fewer, also a
    network that is told all poses fails on others: with 64 of CNN 22 % of the loss are left.

    Args:
        full: As for all tasks.
        params: The parameters of the scene, of a pose, which begins with an angle.
        spread: Entries of poses are uniform between minus and plus this.
        data: The seed of the poses of all pictures.
        others: Pictures to judge by; by default 32, and 64.
        named: The task's name and title.
    """
    size, cases, held_out = (64, 1024, others or 64) if full else (32, 256, others or 32)
    much = Effort(400_000, 3600, seeds=5) if full else Effort(16_000, 240, seeds=1)
    render, cleaner = (
        picture(mug.scene, params, resolution=size, spp=spp) for spp in (SPP, SCORE_SPP)
    )

    poses = np.random.default_rng(data).uniform(-1, 1, (cases + held_out, len(spread)))
    poses = jnp.asarray(poses * spread, jnp.float32)
    pictures = jax.jit(jax.vmap(render))(poses)
    mean = jnp.mean(pictures, axis=0)
    contrast = jnp.std(pictures - mean[None])
    unseen, their_poses = pictures[cases:], poses[cases:]
    clean = jax.jit(jax.vmap(cleaner))(their_poses)

    def initial(seed: int) -> Network:
        return Network(len(spread), jax.random.key(seed))

    arrays, rest = eqx.partition(initial(0), eqx.is_array)
    _, unravel = ravel_pytree(arrays)

    def flat(network: Network) -> Float[Array, "weights"]:
        return ravel_pytree(eqx.filter(network, eqx.is_array))[0]

    def seen(photo: Float[Array, "size size 3"]) -> Float[Array, "size size 3"]:
        return (photo - mean) / contrast

    def white(
        y: Float[Array, "weights"], photo: Float[Array, "size size 3"]
    ) -> Float[Array, "outputs"]:
        return eqx.combine(unravel(y), rest)(seen(photo))

    def exact_loss(y: Float[Array, "weights"]) -> Float[Array, ""]:
        rendered = jax.vmap(lambda photo: cleaner(white(y, photo)))(unseen)
        return jnp.mean((rendered - clean) ** 2)

    def distance(y: Float[Array, "weights"]) -> Float[Array, ""]:
        off = jax.vmap(partial(white, y))(unseen) - their_poses
        angle = jnp.mod(off[:, 0] + jnp.pi, 2 * jnp.pi) - jnp.pi
        return jnp.sqrt(jnp.mean(off.at[:, 0].set(angle) ** 2))

    def image(y: Float[Array, "weights"]) -> Float[Array, "size width 3"]:
        return jnp.concatenate([render(white(y, photo)) for photo in unseen[:SHOWN]], axis=1)

    reference = flat(solved(initial(2**31), jax.vmap(seen)(pictures), poses, held_out))
    return Task(
        problem=Problem(
            bounds=(jnp.full_like(reference, -BOUND), jnp.full_like(reference, BOUND)),
            sigma=SIGMA,
            budget=much.budget,
            grey=Grey(white, render, pictures[:cases], POSE_SIGMA),
        ),
        score=Score(reference, exact_loss, image, distance),
        start=lambda seed: flat(initial(seed)),
        seeds=much.seeds,
        notes=f"{cases} pictures of {size} x {size} pixels, {SPP} samples per pixel. An evaluation "
        f"is a render. Errors are those on {held_out} other pictures, by renders with {SCORE_SPP} "
        "samples per pixel; parameters are poses.",
        **named,
    )


def solved(network: Network, pictures: Array, poses: Array, exact: int) -> Network:
    """The network with another last layer, one that knows the poses of all pictures.

    About: as well as 256 units can. The poses of the last few pictures, `exact` of them, it knows.
    """
    features = jax.vmap(network.hidden)(pictures)
    weights, bias = last_layer(features, poses, 1e-4)
    missing = poses[-exact:] - features[-exact:] @ weights.T - bias[None]
    more_weights, more_bias = last_layer(features[-exact:], missing, 1e-4)
    last = weights + more_weights, bias + more_bias
    return eqx.tree_at(lambda n: (n.layers[1].weight, n.layers[1].bias), network, last)


def turned(pose: Float[Array, "outputs"]) -> Float[Array, "1"]:
    """The angle of the mug: at 0 of the pose, in radians, the handle points at the camera."""
    return np.pi + pose[:1]


def aside(pose: Float[Array, "5"]) -> Float[Array, "3"]:
    """How far camera and flash are moved: to the other side than the mug would be."""
    return jnp.array([-ASIDE, 0.0, 0.0]) * pose[1]


ROTATION: Params = {name: lambda pose, of=of: of(turned(pose)) for name, of in mug.TURNED.items()}
# an angle, a position, and red, green and blue
POSE: Params = {
    **ROTATION,
    "camera.translate": aside,
    "lamp.position": lambda pose: jnp.array(mug.CAMERA, jnp.float32) + aside(pose),
    "lamp.intensity.value": lambda pose: jnp.maximum(BRIGHT + TINT * pose[2:5], 0),
}

TASKS = entry(
    "network",
    network_task,
    "cnn",
    "CNN: 267,745 weights of a network that sees a mug's rotation",
    parameters=267_745,
    plateaus=True,
    params=ROTATION,
    spread=(2.2,),
) | entry(
    "network",
    network_task,
    "cnn5",
    "CNN5: 268,773 weights of a network that sees a mug's pose and colour",
    parameters=268_773,
    plateaus=True,
    params=POSE,
    spread=(1.5,) * 5,
)
