"""What a network learns, by AD and without a render: the answers that are known to be best.

For a picture of a case that is the best that was found, for a render what was rendered. So it has
as many pictures to learn from as there were renders. All within the range of what is known to be
best count alike: the cases, whose answers are not quite right, are soon few among the renders. The
weights of late lessons are averaged (Shamir and Zhang, Stochastic gradient descent for non-smooth
optimization, 2013).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key, PyTree

from smoothdiff._grey_cases import Known, Rendered
from smoothdiff._solvers._base import promotion

# pictures in a lesson
_PICTURES = 64
# an error beyond so many sigmas may be the search's
_DOUBT = 0.2
# in the mean of all weights those after t lessons count about as the ninth power of t
_LATE = 10


class Learner(eqx.Module):
    """The weights, their mean over late lessons, and what the optimiser remembers."""

    weights: PyTree[Array]
    mean: PyTree[Array]
    opt_state: Any
    taught: Int[Array, ""]

    @staticmethod
    def start(weights: PyTree[Array], optim: optax.GradientTransformation) -> "Learner":
        """Nothing is learnt yet."""
        with promotion():
            opt_state = jax.tree.map(jnp.asarray, optim.init(weights))
        return Learner(weights, weights, opt_state, jnp.zeros((), jnp.int32))


class Lessons(eqx.Module):
    """How a network is taught.

    Args:
        answer: (weights, picture) -> parameters in units of sigma; AD knows it.
        pictures: Those of the cases.
        optim: The optimiser.
    """

    answer: Callable[[PyTree, Array], Array]
    pictures: Float[Array, "cases ..."]
    optim: optax.GradientTransformation = eqx.field(static=True)

    @eqx.filter_jit
    def answers(
        self, weights: PyTree[Array], pictures: Float[Array, "k ..."]
    ) -> Float[Array, "k n"]:
        """What the network says of pictures."""
        return jax.vmap(lambda picture: self.answer(weights, picture))(pictures)

    @eqx.filter_jit
    def teach(
        self,
        key: Key[Array, ""],
        learner: Learner,
        best: Float[Array, "cases n"],
        rendered: Rendered,
        shares: Float[Array, " cases+kept"],
        counts: Float[Array, " n"],
    ) -> tuple[Learner, Float[Array, ""]]:
        """One step of the optimiser on cases and renders that are drawn; and the misfit before.

        Each is drawn in proportion to its share. Each parameter counts so many times.
        """
        inputs, targets = self._drawn(key, best, rendered, shares)

        def misfit(weights: PyTree) -> Array:
            each = optax.huber_loss(self.answers(weights, inputs), targets, delta=_DOUBT)
            return jnp.mean(counts[None] * each)

        value, slope = jax.value_and_grad(misfit)(learner.weights)
        with promotion():
            updates, opt_state = self.optim.update(slope, learner.opt_state, learner.weights)
            weights = optax.apply_updates(learner.weights, updates)
            share = _LATE / (_LATE + learner.taught)
            mean = jax.tree.map(
                lambda old, new: (old + share * (new - old)).astype(old.dtype),
                learner.mean,
                weights,
            )
        return Learner(weights, mean, opt_state, learner.taught + 1), value

    def _drawn(
        self, key: Array, best: Array, rendered: Rendered, shares: Array
    ) -> tuple[Array, Array]:
        """Pictures and answers, of cases and renders, in proportion to their shares."""
        cases, kept = len(self.pictures), len(rendered.points)
        number = jax.random.choice(key, cases + kept, (_PICTURES,), p=shares / jnp.sum(shares))
        # by rounding one may be drawn that has no share
        number = jnp.where(shares[number] > 0, number, jnp.argmax(shares))
        case, render = number % cases, jnp.maximum(number - cases, 0)
        inputs, targets = self.pictures[case], best[case]
        if kept:
            rendering = number >= cases
            spread = rendering.reshape(-1, *(1,) * (inputs.ndim - 1))
            inputs = jnp.where(spread, rendered.shown[render].astype(inputs.dtype), inputs)
            targets = jnp.where(rendering[:, None], rendered.points[render], targets)
        return inputs, targets


def mean_loss(known: Known) -> Float[Array, ""]:
    """Of the best that was rendered of each case, of those that had a render; else infinite."""
    there = jnp.isfinite(known.loss)
    return jnp.where(there.any(), jnp.mean(known.loss, where=there), jnp.inf)
