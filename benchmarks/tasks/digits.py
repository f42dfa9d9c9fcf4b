"""Weights of small networks that draw handwritten digits, scikit-learn's; one of many is sought.

`mlp`: a network 256 -> 32 -> 32 -> 784 draws one digit; ReLU in the hidden layers and a sigmoid at
the end; the input is one fixed vector.

`spline-vae`: a decoder 20 -> 34 -> 146 -> 20 draws ten digits, each as one curve. The encoder is
trained beforehand and kept: the linear variational autoencoder, whose optimum is known in closed
form, the whitened principal components. From the code of a digit, the decoder moves ten points
away from the diagonal; a spline through them is drawn with a pen that fills pixels, so the picture
is piecewise constant. Ours differs from the paper's in what makes it exact: codes are means, so
nothing is random and the divergence, which the decoder does not change, is left out; and targets
are one-stroke digits that a known decoder draws, so the lowest loss is 0.

Sigma is that of ZeroGrads (supplement, Table 1).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from scipy import interpolate, ndimage

from benchmarks._task import Effort, NotAble, Task, entry
from benchmarks.scenes import networks
from benchmarks.tasks._drawn import drawn

SIGMA = 0.025
BOUND = 5.0  # of a weight
PIXELS = 28
# of mlp
LAYERS = (256, 32, 32, PIXELS**2)
DIGIT = 3
CONTRAST = 0.96  # of the digit: a sigmoid reaches neither 0 nor 1
INPUT = np.random.default_rng(0).uniform(-1, 1, LAYERS[0])
# of spline-vae
DECODER = (20, 34, 146, 20)
POINTS, SAMPLES = 10, 120  # of a spline: what it goes through, and what is drawn
PEN = 2  # its width, in pixels
TIMES = np.linspace(0, POINTS - 1, SAMPLES)
SPLINE = interpolate.CubicSpline(np.arange(POINTS), np.eye(POINTS))(TIMES)  # from its points
DIAGONAL = np.stack([np.linspace(0.2, 0.8, POINTS)] * 2, axis=1)
# the points of the digits from 0 to 9, x to the right and y downwards, in percent of the picture
STROKES = """
    50 15  34 22  27 40  27 60  34 78  50 85  66 78  73 60  73 40  55 16
    38 30  44 24  50 16  50 26  50 36  50 46  50 56  50 66  50 76  50 86
    28 32  36 18  54 15  68 24  66 40  54 56  40 70  28 84  48 84  72 84
    30 20  50 14  68 24  64 40  46 48  64 54  72 68  62 82  46 86  28 78
    58 14  46 32  34 48  26 60  44 60  62 60  76 60  60 48  58 66  58 86
    70 16  52 16  34 16  32 32  32 46  50 44  68 54  68 72  50 86  28 80
    62 14  44 26  32 46  28 66  38 84  58 86  70 72  62 56  44 54  32 66
    28 16  42 16  58 16  74 16  68 28  60 40  53 52  48 64  44 76  41 88
    64 24  50 14  36 24  42 40  58 54  66 70  50 86  34 70  44 52  64 26
    68 28  54 14  36 22  34 40  50 50  66 40  69 24  66 48  58 68  48 88
"""
DIGITS = np.array(STROKES.split(), float).reshape(-1, POINTS, 2) / 100


def written() -> tuple[np.ndarray, np.ndarray]:
    """All digits as they were written, (1797, 8, 8) from 0 to 1, and the first of each."""
    try:
        from sklearn import datasets
    except ImportError as error:
        raise NotAble("needs a package: pip install scikit-learn") from error
    values, which = datasets.load_digits(return_X_y=True)
    first = np.unique(np.asarray(which), return_index=True)[1]
    return np.asarray(values).reshape(-1, 8, 8) / 16, first


def draw(layers: networks.Layers) -> Float[Array, "784"]:
    """What a network draws."""
    return jax.nn.sigmoid(networks.apply(layers, jnp.asarray(INPUT, layers[0][0].dtype)))


def solved() -> networks.Layers:
    """A network that draws the digit, enlarged to 28 x 28 pixels: all is in the last bias."""
    images, first = written()
    small = images[first[DIGIT]]
    zoom = PIXELS / len(small)
    digit: Any = ndimage.zoom(small, zoom, order=1, mode="nearest", grid_mode=True)
    target = 0.5 + CONTRAST * (digit.ravel() - 0.5)
    layers = jax.tree.map(jnp.zeros_like, networks.initial(LAYERS, jax.random.key(0)))
    layers[-1] = layers[-1][0], jnp.asarray(np.log(target / (1 - target)), jnp.float32)
    return layers


def codes() -> Float[np.ndarray, "10 20"]:
    """What the encoder says of the first of each digit."""
    images, first = written()
    flat = images.reshape(len(images), -1)
    centred = flat - flat.mean(axis=0)
    _, spreads, directions = np.linalg.svd(centred, full_matrices=False)
    size = DECODER[0]
    return (centred @ directions[:size].T * (len(flat) ** 0.5 / spreads[:size]))[first]


def rasterise(points: Float[Array, "10 2"]) -> Float[Array, "28 28"]:
    """The spline through the points: 1 where a square pen has been."""
    curve = jnp.asarray(SPLINE, points.dtype) @ points * PIXELS
    middles = jnp.asarray(np.arange(PIXELS) + 0.5, points.dtype)
    near = (jnp.abs(curve[..., None] - middles[None, None]) <= PEN / 2).astype(points.dtype)
    # a square is a product of two lines of pixels
    return (near[:, 1].T @ near[:, 0] > 0).astype(points.dtype)


def decode(decoder: networks.Layers, code: Float[Array, "20"]) -> Float[Array, "28 28"]:
    """What a decoder draws for a code."""
    moves = networks.apply(decoder, code).reshape(POINTS, 2)
    return rasterise(jnp.asarray(DIAGONAL, moves.dtype) + moves)


def solved_decoder(codes: Float[Array, "10 20"]) -> networks.Layers:
    """A decoder that draws the digits: one before training, but for its last layer."""
    layers = networks.initial(DECODER, jax.random.key(2**31))
    features = jax.vmap(lambda code: networks.hidden(layers, code))(codes)
    moves = (DIGITS - DIAGONAL).reshape(len(DIGITS), -1)
    return [*layers[:-1], networks.last_layer(features, moves)]


def _task(
    full: bool,
    draw: Callable[[networks.Layers], Float[Array, "..."]],
    solved: networks.Layers,
    look: Callable[[Array], Float[Array, "height width"]],
    many: str,
    **named: Any,
) -> Task:
    """Starts are networks as they are before training; `look` arranges what is drawn."""
    reference, layers = ravel_pytree(solved)
    sizes = [solved[0][0].shape[1], *(bias.size for _, bias in solved)]
    return drawn(
        full,
        draw=lambda y: draw(layers(y)),
        reference=reference,
        sigma=SIGMA,
        effort=(Effort(4000, 120, seeds=1), Effort(100_000, 1200, seeds=10)),
        start=lambda seed: ravel_pytree(networks.initial(sizes, jax.random.key(seed)))[0],
        bounds=(-BOUND, BOUND),
        image=lambda y: jnp.repeat(look(draw(layers(y)))[..., None], 3, axis=-1),
        notes=f"Many {many}: the parameter error says nothing.",
        **named,
    )


def mlp(full: bool, **named: Any) -> Task:
    look = lambda grey: grey.reshape(PIXELS, PIXELS)
    return _task(full, draw, solved(), look, "networks draw the digit", **named)


def spline_vae(full: bool, **named: Any) -> Task:
    code = jnp.asarray(codes(), jnp.float32)
    draw = jax.jit(lambda layers: jax.vmap(lambda code: decode(layers, code))(code))
    look = lambda ten: jnp.block([list(row) for row in ten.reshape(2, 5, PIXELS, PIXELS)])
    return _task(full, draw, solved_decoder(code), look, "decoders draw the digits", **named)


TASKS = entry(
    "program",
    mlp,
    "mlp",
    "MLP: 35,152 weights of a network that draws a digit",
    parameters=35_152,
    plateaus=False,
)
TASKS |= entry(
    "program",
    spline_vae,
    "spline-vae",
    "Spline VAE: 8,764 weights of a decoder that draws digits",
    parameters=8_764,
    plateaus=True,
)
