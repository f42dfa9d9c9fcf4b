"""Ten small simulators with known answers: what they return, and in which ranges one searches.

Drawings, a queue, a crowd, switches, gears and a lens: what people fit with such a
library, written for this study alone. None of them is a scene or a problem of another benchmark.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw
from scipy.integrate import solve_ivp

PIXELS = 48


class Simulator(NamedTuple):
    """What it returns for natural parameters, where these may be, and what is to be found."""

    title: str
    run: Callable[[np.ndarray], np.ndarray]
    low: Sequence[float]
    high: Sequence[float]
    truth: Sequence[float]


def drawn(draw: Callable[[ImageDraw.ImageDraw], None]) -> np.ndarray:
    """The grey levels of a picture of whole pixels, over the root of their number."""
    picture = Image.new("L", (PIXELS, PIXELS))
    draw(ImageDraw.Draw(picture))
    return np.asarray(picture, float).ravel() / 255 / PIXELS


def rectangles(p: np.ndarray) -> np.ndarray:
    """Two, one before the other: corner, width and height of each."""
    ends = [PIXELS * np.array([x, y, x + w, y + h]) for x, y, w, h in p.reshape(2, 4)]

    def both(to):
        for end, grey in zip(ends, (120, 230), strict=True):
            to.rectangle(end.tolist(), fill=grey)

    return drawn(both)


def star(p: np.ndarray) -> np.ndarray:
    """The radii of six corners."""
    t = np.arange(6) * np.pi / 3
    x, y = PIXELS * (0.5 + p * np.cos(t)), PIXELS * (0.5 + p * np.sin(t))
    return drawn(lambda to: to.polygon(list(zip(x, y, strict=True)), fill=255))


def discs(p: np.ndarray) -> np.ndarray:
    """The middles of three, of other sizes and greys; later ones hide earlier ones."""

    def three(to):
        for (x, y), r, grey in zip(p.reshape(3, 2), (0.12, 0.16, 0.2), (90, 160, 250), strict=True):
            to.ellipse((PIXELS * np.array([x - r, y - r, x + r, y + r])).tolist(), fill=grey)

    return drawn(three)


def queue(p: np.ndarray) -> np.ndarray:
    """200 customers of fixed luck: means and maxima of waits, and who left."""
    arrivals, service, patience = p
    random = np.random.default_rng(3)
    at = np.cumsum(random.exponential(size=200) / arrivals)
    needs = random.exponential(size=200) / service
    free, waits = 0.0, np.full(200, -1.0)
    for i in range(200):
        wait = max(0.0, free - at[i])
        if wait <= patience:
            waits[i], free = wait, max(free, at[i]) + needs[i]
    waits = waits.reshape(10, 20)
    left = waits < 0
    parts = np.where(left, 0, waits).mean(1), left.mean(1), waits.max(1)
    return np.concatenate([*parts, [at[-1] / 50, free / 50]])


def epidemic(p: np.ndarray) -> np.ndarray:
    """The infected over time: infection, recovery, share at the start."""
    rate, recovery, share = p
    change = lambda t, y: [-rate * y[0] * y[1], rate * y[0] * y[1] - recovery * y[1]]
    how = {"t_eval": np.linspace(0, 60, 40), "rtol": 1e-5, "atol": 1e-8}
    return 10 * solve_ivp(change, (0, 60), [1 - share, share], **how).y[1]


def crowd(p: np.ndarray) -> np.ndarray:
    """Walkers of fixed luck, who draw together: shares in sixteen cells, at six times."""
    moving, drawing, sight = p
    random = np.random.default_rng(1)
    x, shares = random.uniform(size=(40, 2)), []
    for step in range(30):
        walks, where_to = random.uniform(size=40) < moving, 0.05 * random.normal(size=(40, 2))
        sees = np.linalg.norm(x[:, None] - x[None], axis=-1) < sight
        middle = (sees[..., None] * x[None]).sum(1) / sees.sum(1)[:, None]
        x = np.where(walks[:, None], x + where_to, x) + drawing * (middle - x)
        x = np.clip(x, 0, 1)
        if step % 5 == 4:
            cells = np.histogram2d(*x.T, bins=4, range=[[0, 1], [0, 1]])[0]
            shares.append(cells.ravel() / 40)
    return np.concatenate(shares)


def thermostat(p: np.ndarray) -> np.ndarray:
    """Temperatures: where it switches on, how much later off, power, loss."""
    low, band, power, loss = p
    now, on, seen = 10.0, False, []
    for _ in range(200):
        on = now < low or (on and now <= low + band)
        now += 0.1 * (power * on - loss * (now - 5))
        seen.append(now)
    return np.array(seen) / 10


def gears(p: np.ndarray) -> np.ndarray:
    """Speeds of a car: where it shifts, twice; mass, drag."""
    first, second, mass, drag = p
    now, seen = 0.0, []
    for _ in range(150):
        force = 4.0 if now < first else 2.4 if now < second else 1.5
        now += 0.1 * (force - drag * now * now / 100) / mass
        seen.append(now)
    return np.array(seen)


def waves(p: np.ndarray) -> np.ndarray:
    """A sine of unknown frequency and a decay: smooth, with many minima."""
    size, frequency, phase, other, decay = p
    t = np.linspace(0, 6, 120)
    return size * np.sin(frequency * t + phase) + other * np.exp(-decay * t)


def lens(p: np.ndarray) -> np.ndarray:
    """401 rays through two lenses and a stop: how many of them hit which cell of a screen."""
    first, second, between, stop, screen = p
    y = np.linspace(-1, 1, 401)
    y = y[np.abs(y) < stop]
    slope = -y / first / 2
    y = y + between * slope
    slope = slope - y / second / 2
    return np.histogram(y + screen * slope, bins=40, range=(-1, 1))[0] / 20.0


SIMULATORS = {
    "rectangles": Simulator(
        "two rectangles of pixels",
        rectangles,
        [0, 0, 0.1, 0.1] * 2,
        [0.6, 0.6, 0.4, 0.4] * 2,
        [0.1, 0.2, 0.3, 0.35, 0.45, 0.4, 0.25, 0.2],
    ),
    "star": Simulator(
        "star of pixels", star, [0.1] * 6, [0.48] * 6, [0.4, 0.2, 0.44, 0.3, 0.15, 0.35]
    ),
    "discs": Simulator(
        "three discs of pixels", discs, [0.15] * 6, [0.85] * 6, [0.3, 0.3, 0.7, 0.4, 0.45, 0.7]
    ),
    "queue": Simulator("queue", queue, [0.3, 0.3, 0.5], [2, 2, 8], [1.0, 1.1, 3.0]),
    "epidemic": Simulator(
        "epidemic", epidemic, [0.1, 0.02, 1e-4], [1.5, 0.5, 0.05], [0.5, 0.12, 0.002]
    ),
    "crowd": Simulator("crowd", crowd, [0.05, 0, 0.05], [0.95, 0.3, 0.5], [0.6, 0.1, 0.2]),
    "thermostat": Simulator(
        "thermostat", thermostat, [15, 0.5, 5, 0.1], [25, 5, 30, 1.0], [19, 2, 14, 0.5]
    ),
    "gears": Simulator("gears", gears, [1, 8, 1, 0.2], [8, 20, 4, 4], [4, 11, 2, 1.0]),
    "waves": Simulator(
        "waves", waves, [0.2, 1, -2, -2, 0.1], [2, 6, 2, 2, 2], [1, 3.2, 0.5, 1.2, 0.6]
    ),
    "lens": Simulator(
        "rays through lenses",
        lens,
        [0.5, 0.5, 0.1, 0.3, 0.3],
        [3, 3, 1, 1, 3],
        [1.2, 1.8, 0.4, 0.7, 1.1],
    ),
}
