"""`train_grey_box`: a network is trained by AD through a renderer that AD knows nothing of."""

import functools
import os
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, ArrayLike, PyTree
from tqdm import tqdm

from smoothdiff._call_checks import explained
from smoothdiff._ctrl_c import ctrl_c_noticed, is_ctrl_c, raise_if_pressed
from smoothdiff._grey_cases import CaseSearches
from smoothdiff._grey_lessons import Learner, Lessons
from smoothdiff._grey_result import GreyBoxError, GreyRecord, GreyResult
from smoothdiff._grey_run import Answer, GreyRun, GreyState, Shown
from smoothdiff._grey_sensitivity import Sensitivity
from smoothdiff._host_samples import BlackBoxError
from smoothdiff._numbers import check_whole
from smoothdiff._params import as_key, take_apart

# of Adam, and what is left of it at the end
_RATE, _DECAY = 3e-3, 0.02


def train_grey_box(
    model: Callable[[Array], PyTree],
    render: Callable[[PyTree], Array],
    pictures: ArrayLike,
    *,
    key: Any,
    sigma: PyTree,
    max_evaluations: int,
    optim: optax.GradientTransformation | None = None,
    lessons: int = 128,
    cases: int = 32,
    kept: int = 16384,
    new_parameters: bool = True,
    target: float | None = None,
    max_seconds: float | None = None,
    callback: Callable[[GreyRecord], Any] | None = None,
    progress: bool = False,
    checkpoint: str | os.PathLike | None = None,
) -> GreyResult:
    r"""Trains a network that says what to render for a picture, through a black box, no labels.

    $$ \min_\phi \frac1C \sum_c \| R(g_\phi(I_c)) - I_c \|^2, \qquad
       x_c \approx \arg\min_x \| R(x) - I_c \|^2, \qquad
       \phi \approx \arg\min_\phi \sum_{ij} w_j h(g_\phi(R(x_i))_j - x_{ij}) $$

    A case is a picture I. AD can differentiate the network g, and not the renderer R. So the
    problem is split in two:

    - **Search.** For each case a Gauss-Newton search looks for the parameters x whose render is
      most like the picture. Each render is compared with the pictures of all cases, so that no case
      stays in a wrong valley. Where the network's answer is nearer, the search goes on from there.
    - **Lessons.** The network learns by AD, without a render, to answer the best parameters that
      are known. A render is a picture whose parameters are known, so it learns from renders too:
      from all whose parameters are within the range of the best ones. A few best ones that lie
      apart do not count, neither for the range nor as lessons. h is Huber's loss. The weight w_j is
      the root of how much a picture changes with parameter j, one in the mean.

    The renders of the searches soon look like the pictures themselves. So half of all renders are
    of new parameters, drawn from a kernel density estimate of the best ones. The network then sees
    as many different pictures as there are renders, and does better on pictures that it has not
    seen. At most one in eight of the new parameters are earlier ones with one entry moved by as
    much as the network is usually off in it: w is measured with them. In each round some cases take
    a step, and then the network gets its lessons.

    Args:
        model: the network: `model(picture)` gives the parameters of the renderer, an array or a
            pytree. Any pytree with arrays of floating-point numbers, such as a module of equinox.
            It is not changed; the trained one is in the result.
        render: the renderer, from these parameters to a picture, a JAX function or a `black_box`.
            Renders that are NaN or infinite are left out. The same parameters should give the same
            picture: of a random renderer fix the seed.
        pictures: the training pictures, an array whose first axis counts the cases; each has the
            shape of a render.
        key: a random key; the same key gives the same training.
        sigma: how far from an answer to look, in the units of the parameters: a number or a pytree
            like them.
        max_evaluations: the most renders, never exceeded.
        optim: an optax transformation. By default Adam, whose rate falls from 3e-3 to 6e-5 over the
            lessons.
        lessons: updates of the network in a round, each on 64 pictures.
        cases: how many cases take a step in a round.
        kept: how many of the last renders to remember, with their pictures. With 0 there are no new
            parameters, and a case learns from its own renders alone. That is for pictures which no
            render looks like.
        new_parameters: whether half of all renders are of new parameters. These renders teach the
            network alone; the searches gain nothing from them. Without them all w_j are one.
        target: a loss that is good enough: the mean over the cases of a round, of the network's
            answers.
        max_seconds: seconds after which no further round begins.
        callback: called with each round's `GreyRecord`; the training stops if it returns something
            true.
        progress: show a progress bar.
        checkpoint: a file that keeps the training. The same call continues it, and ends with the
            same network as without an interruption. With a larger `max_evaluations` it goes on.

    Returns:
        A `GreyResult`. Ctrl-C ends the training and returns what there is.

    Raises:
        GreyBoxError: a black box failed, or no render of the first round was finite. Its `result`
            has what was found, and the checkpoint is written.
        TypeError, ValueError: an argument that cannot work; a checkpoint of another problem.

    Example:
        >>> import equinox as eqx, jax, jax.numpy as jnp, smoothdiff as sd
        >>> pixels = jnp.linspace(0, 1, 16)
        >>> render = lambda x: jnp.where(jnp.abs(pixels - x) < 0.2, 1.0, 0.0)
        >>> pictures = jax.vmap(render)(jax.random.uniform(jax.random.key(1), (64,)))
        >>> network = eqx.nn.MLP(16, "scalar", 32, 1, key=jax.random.key(2))
        >>> result = sd.train_grey_box(
        ...     network, render, pictures, key=jax.random.key(0), sigma=0.3, max_evaluations=4000
        ... )
        >>> abs(float(result.model(render(0.35))) - 0.35) < 0.05
        True

    Source: own; the network by AD and the renderer by samples are appendix E of the paper on
    higher-order rendering, the split is that of auxiliary coordinates (Carreira-Perpinan and Wang,
    2014).
    """
    key, pictures = as_key(key), _pictures(pictures)
    counts = {"max_evaluations": max_evaluations, "lessons": lessons, "cases": cases}
    for name, count in counts.items():
        check_whole(count, name)
        if count < 1:
            raise ValueError(f"{name}={count} must be a positive whole number")
    check_whole(kept, "kept")
    if kept < 0:
        raise ValueError(f"kept={kept} must be 0 or more")
    weights, static = eqx.partition(model, eqx.is_inexact_array)
    answer, shown = _parts(model, static, render, pictures, sigma)
    searches = CaseSearches(
        shown,
        pictures,
        answer.sigma.size,
        min(cases, len(pictures)),
        kept,
        new_parameters and kept > 0,
    )
    planned = max_evaluations // searches.evaluations
    if planned < 1:
        raise ValueError(
            f"max_evaluations={max_evaluations} leaves no room for a round, which takes "
            f"{searches.evaluations} renders: allow more, or lower cases"
        )
    used = _adam(planned * lessons) if optim is None else optim
    taught = Lessons(answer, pictures, used)
    known, rendered = searches.begin(key, taught.answers(weights, pictures))
    none = jnp.zeros((), jnp.int32)
    alike = Sensitivity.start(known.best[0])
    state = GreyState(none, Learner.start(weights, used), known, rendered, alike)
    run = GreyRun(searches, taught, answer, key, state, planned, lessons)
    if checkpoint is not None:
        settings = lessons, cases, kept, new_parameters
        problem = {"fun": render, "model": model, "pictures": pictures, "sigma": sigma}
        run.attach(checkpoint, **problem, optim=optim, settings=settings)
    return _loop(run, target, max_seconds, callback, progress)


@functools.cache
def _adam(lessons: int) -> optax.GradientTransformation:
    """The same object each time, or else lessons would be compiled for each training."""
    return optax.adam(optax.linear_schedule(_RATE, _DECAY * _RATE, lessons))


def _loop(
    run: GreyRun,
    target: float | None,
    max_seconds: float | None,
    callback: Callable[[GreyRecord], Any] | None,
    progress: bool,
) -> GreyResult:
    """Rounds until something ends them."""
    with ctrl_c_noticed():
        try:
            return run.found(_ended(run, target, max_seconds, callback, progress))
        except BaseException as error:
            if is_ctrl_c(error):
                return run.found("interrupted")
            if isinstance(error, BlackBoxError | jax.errors.JaxRuntimeError):
                raise GreyBoxError(str(error), run.found("failed")) from (error.__cause__ or error)
            raise
        finally:
            run.save()


def _ended(
    run: GreyRun,
    target: float | None,
    max_seconds: float | None,
    callback: Callable[[GreyRecord], Any] | None,
    progress: bool,
) -> str:
    """Why there are no more rounds, after them."""
    with tqdm(total=run.planned, initial=run.rounds, disable=not progress) as bar:
        while (reason := _reached(run, target, max_seconds)) is None:
            record = run.round()
            raise_if_pressed()
            bar.set_postfix_str(f"{record.evaluations} renders, loss {record.fun:.4g}", False)
            bar.update()
            if callback is not None and callback(record):
                return "callback"
    return reason


def _reached(run: GreyRun, target: float | None, max_seconds: float | None) -> str | None:
    """Why the training has to end here, if it has to."""
    if target is not None and run.history and run.history[-1].fun <= target:
        return "target"
    if run.rounds >= run.planned:
        return "max_evaluations"
    if max_seconds is not None and run.seconds >= max_seconds:
        return "max_seconds"
    return None


def _pictures(pictures: Any) -> Array:
    """The pictures as one array, in floating-point numbers."""
    pictures = jnp.asarray(pictures)
    if pictures.ndim < 2 or len(pictures) == 0:
        raise ValueError(
            f"pictures must be an array whose first axis counts the cases, not {pictures.shape}"
        )
    if not jnp.issubdtype(pictures.dtype, jnp.floating):
        raise TypeError(f"pictures have dtype {pictures.dtype}: use pictures.astype(float)")
    if not jnp.all(jnp.isfinite(pictures)):
        raise ValueError("a picture has numbers that are not finite: leave it out")
    return pictures


def _parts(
    model: Any, static: Any, render: Any, pictures: Array, sigma: PyTree
) -> tuple[Answer, Shown]:
    """Network and renderer in units of sigma, if the one goes with the other."""
    if not callable(model) or not callable(render):
        raise TypeError("the arguments are (model, render, pictures), two functions and an array")
    said = jax.eval_shape(model, pictures[0])
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), said)
    params = take_apart(zeros, sigma, None)
    if params.free:
        raise ValueError("train_grey_box needs a sigma for every parameter of the renderer")
    with explained():
        picture = jax.eval_shape(render, said)
    if getattr(picture, "shape", None) != pictures.shape[1:]:
        raise ValueError(
            f"render gives {picture}, and a picture has shape {pictures.shape[1:]}: both must be "
            "alike"
        )
    layout = params.layout
    return Answer(static, params.sigma, layout), Shown(render, params.sigma, layout)
