"""Spline VAE: the 8,764 weights of a decoder that draws ten digits, each as one curve.

The encoder is trained beforehand and kept: the linear variational autoencoder of scikit-learn's
digits, whose optimum is known in closed form, the whitened principal components. From the code of a
digit, the decoder (20 -> 34 -> 146 -> 20) moves ten points away from the diagonal; a spline through
them is drawn with a pen that fills pixels, so the picture is piecewise constant.

Ours differs from the paper's in what makes it exact: codes are means, so nothing is random and the
divergence, which the decoder does not change, is left out; and targets are one-stroke digits that a
known decoder draws, so the lowest loss is 0. Sigma is that of ZeroGrads (supplement, Table 1).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import interpolate

from benchmarks import methods
from benchmarks._task import Task
from benchmarks.scenes import digits, networks

TITLE = "Spline VAE: 8,764 weights of a decoder that draws digits"
METHODS = methods.MANY_PARAMETERS
LAYERS = (20, 34, 146, 20)
POINTS, SAMPLES = 10, 120  # of a spline: what it goes through, and what is drawn
PEN = 2  # its width, in pixels
SIGMA = 0.025
_TIMES = np.linspace(0, POINTS - 1, SAMPLES)
SPLINE = interpolate.CubicSpline(np.arange(POINTS), np.eye(POINTS))(_TIMES)
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


def codes() -> Float[np.ndarray, "10 20"]:
    """What the encoder says of the first of each digit."""
    images, which = digits.load()
    flat = images.reshape(len(images), -1)
    centred = flat - flat.mean(axis=0)
    _, spreads, directions = np.linalg.svd(centred, full_matrices=False)
    size = LAYERS[0]
    whitened = centred @ directions[:size].T * (len(flat) ** 0.5 / spreads[:size])
    return whitened[[np.flatnonzero(which == digit)[0] for digit in range(10)]]


def rasterise(points: Float[Array, "10 2"]) -> Float[Array, "28 28"]:
    """The spline through the points: 1 where a square pen has been."""
    curve = jnp.asarray(SPLINE, points.dtype) @ points * digits.PIXELS
    middles = jnp.asarray(np.arange(digits.PIXELS) + 0.5, points.dtype)
    near = (jnp.abs(curve[..., None] - middles[None, None]) <= PEN / 2).astype(points.dtype)
    # a square is a product of two lines of pixels
    return (near[:, 1].T @ near[:, 0] > 0).astype(points.dtype)


def draw(decoder: networks.Layers, code: Float[Array, "20"]) -> Float[Array, "28 28"]:
    """What a decoder draws for a code."""
    moves = networks.apply(decoder, code).reshape(POINTS, 2)
    return rasterise(jnp.asarray(DIAGONAL, moves.dtype) + moves)


def solved(codes: Float[Array, "10 20"]) -> networks.Layers:
    """A decoder that draws the digits: one before training, but for its last layer."""
    layers = networks.initial(LAYERS, jax.random.key(2**31))
    features = jax.vmap(lambda code: networks.hidden(layers, code))(codes)
    moves = (DIGITS - DIAGONAL).reshape(len(DIGITS), -1)
    return [*layers[:-1], networks.last_layer(features, moves)]


def build(full: bool) -> Task:
    """Starts are decoders as they are before training."""
    code = jnp.asarray(codes(), jnp.float32)
    decoder = solved(code)

    @jax.jit
    def drawn(layers: networks.Layers) -> Float[Array, "10 28 28"]:
        return jax.vmap(lambda code: draw(layers, code))(code)

    def image(layers: networks.Layers) -> Float[Array, "56 140 3"]:
        grey = jnp.block([list(row) for row in drawn(layers).reshape(2, 5, 28, 28)])
        return jnp.repeat(grey[..., None], 3, axis=-1)

    return networks.weights_task(
        full,
        "spline-vae",
        TITLE,
        drawn,
        drawn(decoder),
        decoder,
        image,
        SIGMA,
        "Many decoders draw the digits: the parameter error says nothing.",
    )
