"""One run: a compiled loop of an optimiser over noisy gradients, looked at now and then."""

import hashlib
import itertools
import time
from collections.abc import Collection
from typing import Any, NamedTuple

import jax
import numpy as np
import optax

from benchmarks.descents._descent import Descent, Optimiser, Scene, Y

POINTS_A_DECADE = 10  # of iterations at which errors are looked at


class Run(NamedTuple):
    """What a run saw. Seconds are those of the iterations alone, without errors or compiling."""

    iterations: np.ndarray
    seconds: np.ndarray
    errors: dict[str, np.ndarray]
    kept: dict[int, Y]  # the parameters at some of the marks


class Loop:
    """An optimiser on a descent. The learning rate is an argument, so it compiles once for all."""

    def __init__(self, descent: Descent, optimiser: Optimiser):
        def begin(y: Y, rate: float) -> Any:
            return optimiser(rate).init(y)

        def advance(y: Y, state: Any, rate: float, key, scene: Scene, first: int, last: int):
            transform = optax.with_extra_args_support(optimiser(rate))

            def step(i, carry):
                y, state = carry
                gradient = descent.gradient(y, jax.random.fold_in(key, i), scene)
                updates, state = transform.update(gradient, state, y)
                return optax.apply_updates(y, updates), state

            return jax.lax.fori_loop(first, last, step, (y, state))

        self._descent = descent
        self._begin, self._advance = jax.jit(begin), jax.jit(advance)
        self._errors = jax.jit(descent.errors)
        self._text = None

    def fingerprint(self, rate: float, seed: int, scene: Scene, last: int) -> str:
        """Changes when the run would: the programs that XLA is given, and their inputs."""
        y = self._descent.start(seed, scene)
        if self._text is None:  # the same for every rate and seed
            advance = self._advance.lower(*self._arguments(y, rate, seed, scene))
            self._text = advance.as_text() + self._errors.lower(y, scene).as_text()
        inputs = [np.asarray(leaf) for leaf in jax.tree.leaves((y, scene))]
        settings = repr((jax.__version__, rate, seed, self._observed(last)))
        digest = hashlib.sha256(settings.encode())
        for content in (self._text.encode(), *(leaf.tobytes() for leaf in inputs)):
            digest.update(content)
        return digest.hexdigest()[:16]

    def __call__(
        self, rate: float, seed: int, scene: Scene, last: int, keep: Collection[int] = ()
    ) -> Run:
        """Descends from the start of a seed to an iteration; keeps y at the iterations `keep`."""
        y, state, *rest = self._arguments(self._descent.start(seed, scene), rate, seed, scene)[:5]
        jax.block_until_ready(self._advance(y, state, *rest, 0, 0))  # compiles
        iterations = self._observed(last)
        seconds, errors, kept = [0.0], [self._errors(y, scene)], {}
        for here, there in itertools.pairwise(iterations):
            began = time.perf_counter()
            y, state = jax.block_until_ready(self._advance(y, state, *rest, here, there))
            seconds.append(seconds[-1] + time.perf_counter() - began)
            errors.append(self._errors(y, scene))
            if there in keep:
                kept[there] = jax.tree.map(np.asarray, y)
        scores = {name: np.array([float(each[name]) for each in errors]) for name in errors[0]}
        for values in scores.values():
            values[np.isnan(values)] = np.inf  # it diverged
        return Run(np.array(iterations), np.array(seconds), scores, kept)

    def _arguments(self, y: Y, rate: float, seed: int, scene: Scene) -> tuple:
        return y, self._begin(y, rate), rate, jax.random.key(seed), scene, 0, 0

    def _observed(self, last: int) -> list[int]:
        """The iterations at which errors are looked at: evenly in the logarithm, and the marks."""
        number = max(2, round(POINTS_A_DECADE * np.log10(last)))
        points = np.geomspace(1, last, number).round().astype(int).tolist()
        return sorted({0, *points, *(mark for mark in self._descent.marks if mark <= last)})
