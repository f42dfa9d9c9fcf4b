"""A network that looks at pictures of a mug and says its pose, trained through the renderer.

After CNN and CNN5 of higher-order differentiable rendering (section 4.1), with as many weights:
three convolutions of 16 channels, 256 units, and the pose. Nobody tells the network the poses of
its training pictures. It is given a picture, a mug in the pose that it says is rendered, and the
loss is how much that differs from the picture.

Left out: Mitsuba need not move the mug, which is round but for its handle. The camera and its flash
move sideways instead, and the colour of the mug is that of the flash, as nothing else is lit. The
noise of all pictures is the same, so the right pose has no loss.
"""

from collections.abc import Callable, Mapping
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from benchmarks._task import Budget, Grey, Task
from benchmarks.scenes import mug, networks
from benchmarks.scenes._mitsuba_task import UP

FRONT = np.pi  # the angle at which the handle points at the camera
SIGMA, BOUND = 0.025, 50.0  # of the weights, for methods that know of nothing else
CHANNELS, GRID, UNITS = 16, 8, 256
SPP, SCORE_SPP = 4, 16  # samples per pixel, and those of pictures by which a network is judged
SHOWN = 6  # pictures of those that were not trained on

Params = Mapping[str, Callable[[Array], Array]]


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

    def hidden(self, picture: Float[Array, "size size 3"]) -> Float[Array, "units"]:
        """What the last layer sees. Channels stay last, as that takes half of the time."""
        x = picture
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

    def __call__(self, picture: Float[Array, "size size 3"]) -> Float[Array, "outputs"]:
        """The pose."""
        return self.layers[1](self.hidden(picture))


def network_task(
    full: bool,
    name: str,
    title: str,
    params: Params,
    spread: tuple[float, ...],
    sigma: float,
    budget: Budget,
) -> Task:
    """The task of training the network. Its weights are y.

    Quick: 32 x 32 pixels, 256 pictures to train on; full: 64 x 64 and 1,024. With fewer, also a
    network that is told all poses fails on others: with 64 of CNN 22 % of the loss are left.

    Args:
        full: As for all tasks.
        name: Of the task.
        title: What is sought.
        params: The parameters of the scene by their names, as functions of a pose, which begins
            with an angle.
        spread: Entries of poses are uniform between minus and plus this.
        sigma: The scale of a pose.
        budget: Where a run ends, in renders.
    """
    import mitsuba as mi

    from smoothdiff.renderers import mitsuba

    mi.set_variant("scalar_rgb")
    scene = mug.scene(mi.ScalarTransform4f())
    size, cases, held_out = (64, 1024, 64) if full else (32, 256, 32)

    def renderer(spp: int) -> Callable[[Float[Array, "outputs"]], Float[Array, "size size 3"]]:
        box = mitsuba.renderer(
            scene, list(params), axis=UP, resolution=size, spp=spp, variant="scalar_rgb"
        )
        return lambda pose: box({key: value(pose) for key, value in params.items()})

    render, cleaner = renderer(SPP), renderer(SCORE_SPP)

    poses = np.random.default_rng(0).uniform(-1, 1, (cases + held_out, len(spread)))
    poses = jnp.asarray(poses * spread, jnp.float32)
    pictures = jax.jit(jax.vmap(render))(poses)
    mean = jnp.mean(pictures, axis=0)
    contrast = jnp.std(pictures - mean[None])
    unseen = jnp.arange(cases, cases + held_out)
    clean = jax.jit(jax.vmap(cleaner))(poses[unseen])

    def initial(seed: int) -> Network:
        return Network(len(spread), jax.random.key(seed))

    arrays, rest = eqx.partition(initial(0), eqx.is_array)
    _, unravel = ravel_pytree(arrays)

    def flat(network: Network) -> Float[Array, "weights"]:
        return ravel_pytree(eqx.filter(network, eqx.is_array))[0]

    def seen(picture: Float[Array, "size size 3"]) -> Float[Array, "size size 3"]:
        return (picture - mean) / contrast

    def white(
        y: Float[Array, "weights"], picture: Float[Array, "size size 3"]
    ) -> Float[Array, "outputs"]:
        return eqx.combine(unravel(y), rest)(seen(picture))

    def exact_loss(y: Float[Array, "weights"]) -> Float[Array, ""]:
        rendered = jax.vmap(lambda picture: cleaner(white(y, picture)))(pictures[unseen])
        return jnp.mean((rendered - clean) ** 2)

    def distance(y: Float[Array, "weights"]) -> Float[Array, ""]:
        said = jax.vmap(partial(white, y))(pictures[unseen])
        off = said - poses[unseen]
        angle = jnp.mod(off[:, 0] + jnp.pi, 2 * jnp.pi) - jnp.pi
        return jnp.sqrt(jnp.mean(off.at[:, 0].set(angle) ** 2))

    def image(y: Float[Array, "weights"]) -> Float[Array, "size width 3"]:
        return jnp.concatenate(
            [render(white(y, pictures[case])) for case in unseen[:SHOWN]], axis=1
        )

    grey = Grey(white, render, pictures[:cases], sigma)
    reference = flat(solved(initial(2**31), jax.vmap(seen)(pictures), poses, held_out))
    return Task(
        name=name,
        title=title,
        loss=grey.loss,
        exact_loss=exact_loss,
        start=lambda seed: flat(initial(seed)),
        reference=reference,
        bounds=(jnp.full_like(reference, -BOUND), jnp.full_like(reference, BOUND)),
        sigma=SIGMA,
        budget=budget,
        seeds=5 if full else 1,
        image=image,
        grey=grey,
        distance=distance,
        notes=f"{cases} pictures of {size} x {size} pixels, {SPP} samples per pixel. An evaluation "
        f"is a render. Errors are those on {held_out} other pictures, by renders with {SCORE_SPP} "
        "samples per pixel; parameters are poses.",
    )


def solved(network: Network, pictures: Array, poses: Array, exact: int) -> Network:
    """The network with another last layer, one that knows the poses of all pictures.

    About: as well as 256 units can. The poses of the last few pictures, `exact` of them, it knows.
    """
    features = jax.vmap(network.hidden)(pictures)
    weights, bias = networks.last_layer(features, poses, 1e-4)
    missing = poses[-exact:] - features[-exact:] @ weights.T - bias[None]
    more_weights, more_bias = networks.last_layer(features[-exact:], missing, 1e-4)
    last = weights + more_weights, bias + more_bias
    return eqx.tree_at(lambda n: (n.layers[1].weight, n.layers[1].bias), network, last)
