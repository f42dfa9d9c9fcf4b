"""Four simulators of other libraries, each as a user would write it: NumPy in, NumPy out."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree
from PIL import Image, ImageDraw
from scipy.integrate import solve_ivp
from sklearn.datasets import load_diabetes
from sklearn.model_selection import cross_val_score
from sklearn.svm import SVR

import smoothdiff as sd


class Simulator(NamedTuple):
    """A host function of natural values, what they may be, and whether it returns residuals."""

    title: str
    run: Callable[[Any], Any]
    space: PyTree
    truth: PyTree | None

    def fun(self) -> Callable[[PyTree, PyTree], Array]:
        """What is minimised: residuals against what the truth gives, or the number itself."""
        example = dict.fromkeys(self.space, 1.0)
        seen = self.run(self.truth or example)
        shape = jax.ShapeDtypeStruct(np.shape(seen), jnp.float32)
        box = sd.black_box(self.run, shape, on_nonfinite="nan")
        told = 0.0 if self.truth is None else jnp.asarray(seen, jnp.float32)
        return lambda y, args: box(y) - told

    def start(self, seed: int) -> PyTree:
        """Somewhere in the middle nine tenths of the ranges."""
        rng = np.random.default_rng(seed)
        shares = {name: rng.uniform(0.05, 0.95) for name in self.space}
        return {name: float(of.to_natural(shares[name])) for name, of in self.space.items()}


def ball(y: dict) -> np.ndarray:
    """Where a ball is that bounces four times: SciPy's solve_ivp stops at each impact."""
    state, now, places = [0.0, float(y["height"]), float(y["speed"]), 0.0], 0.0, []
    times = np.linspace(0, 3, 41)[1:]
    fall = lambda t, s: [s[2], s[3], 0, -9.81]
    for _ in range(5):
        due = times[times > now]
        way = solve_ivp(fall, (now, 3.0), state, t_eval=due, events=_ground, rtol=1e-6)
        places += list(np.reshape(way.y, (4, -1))[:2].T)  # an empty list where none was due
        if way.status == 0 or not len(way.t_events[0]):
            break
        now, state = way.t_events[0][0], way.y_events[0][0]
        state = [state[0], 0.0, state[2], -float(y["bounce"]) * state[3]]
    rest = [[state[0], 0.0]] * (len(times) - len(places))  # it has come to lie
    return np.asarray(places + rest, np.float32)


def _ground(t: float, s: np.ndarray) -> float:
    return s[1]


setattr(_ground, "terminal", True)  # noqa: B010, as solve_ivp asks for
setattr(_ground, "direction", -1)  # noqa: B010


def drawing(y: dict) -> np.ndarray:
    """An ellipse of whole pixels, turned: Pillow draws it without shades."""
    picture = Image.new("L", (96, 96))
    turns = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    x, z = float(y["width"]) * np.cos(turns), float(y["height"]) * np.sin(turns)
    c, s = np.cos(float(y["angle"])), np.sin(float(y["angle"]))
    corners = zip(y["x"] + c * x - s * z, y["y"] + s * x + c * z, strict=True)
    ImageDraw.Draw(picture).polygon([(float(a), float(b)) for a, b in corners], fill=1)
    return np.asarray(picture, np.float32)


def reaction(y: dict) -> np.ndarray:
    """Robertson's stiff reaction, whose rates differ by many orders."""

    def rates(t: float, s: np.ndarray) -> list[float]:
        a, b, c = (float(y[name]) for name in ("slow", "fast", "back"))
        first, second = a * s[0], b * s[1] ** 2
        third = c * s[1] * s[2]
        return [third - first, first - third - second, second]

    times = np.geomspace(1e-3, 1e3, 25)
    way = solve_ivp(rates, (0, 1e3), [1, 0, 0], "BDF", times, rtol=1e-8, atol=1e-12)
    seen = np.full((3, len(times)), np.nan)
    seen[:, : way.y.shape[1]] = way.y
    return (seen * np.array([[1], [1e4], [1]])).astype(np.float32)


def model(y: dict) -> np.ndarray:
    """The error of support vector regression in threefold cross-validation, scikit-learn."""
    inputs, targets = load_diabetes(return_X_y=True)
    settings: Any = {name: float(y[name]) for name in ("C", "gamma", "epsilon")}
    fit = SVR(**settings)
    scored = {"cv": 3, "scoring": "neg_mean_squared_error"}
    scores = cross_val_score(fit, inputs[:120], targets[:120], **scored)
    return np.asarray(-np.mean(scores), np.float32)


SIMULATORS = {
    "ball": Simulator(
        "bouncing ball, SciPy with events",
        ball,
        {"height": sd.Range(0.5, 5.0), "speed": sd.Range(-3.0, 3.0), "bounce": sd.Range(0.3, 0.95)},
        {"height": 2.3, "speed": 1.1, "bounce": 0.7},
    ),
    "drawing": Simulator(
        "ellipse, Pillow",
        drawing,
        {
            "x": sd.Range(20.0, 76.0),
            "y": sd.Range(20.0, 76.0),
            "width": sd.Range(8.0, 40.0),
            "height": sd.Range(8.0, 40.0),
            "angle": sd.Range(0.0, np.pi),
        },
        {"x": 57.0, "y": 41.0, "width": 29.0, "height": 13.0, "angle": 0.6},
    ),
    "reaction": Simulator(
        "stiff reaction, SciPy",
        reaction,
        {
            "slow": sd.Range(1e-3, 1.0, log=True),
            "fast": sd.Range(1e5, 1e9, log=True),
            "back": sd.Range(1e2, 1e6, log=True),
        },
        {"slow": 0.04, "fast": 3e7, "back": 1e4},
    ),
    "model": Simulator(
        "support vector regression, scikit-learn",
        model,
        {
            "C": sd.Range(1e-1, 1e5, log=True),
            "gamma": sd.Range(1e-3, 1e3, log=True),
            "epsilon": sd.Range(1e-2, 1e2, log=True),
        },
        None,
    ),
}
