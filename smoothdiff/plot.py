"""Plots of what a run did and found, with matplotlib, which is imported only when one is drawn.

They draw into the axes that they are given, or into a new figure of `matplotlib.pyplot`.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import PyTree

from smoothdiff._run import Result
from smoothdiff._slices import Slices
from smoothdiff._unit_space import UnitSpace

__all__ = ["errors", "history", "slice"]

_FUNCTION, _SMOOTHED, _BAND, _ANSWER = "#0072B2", "0.35", "0.87", "#D55E00"
# of a normal distribution, within which it is with 95 %
_WITHIN = 1.96
# panels in a row
_ABREAST = 4


def history(
    result: Result, *, ax: Any = None, against: Literal["evaluations", "seconds"] = "evaluations"
) -> Any:
    r"""Draws the course of a run: the lowest value so far, and the smoothed function.

    $$ \min_{i \le t} f(x_i) \quad\text{and}\quad F(y_t) \pm 1.96 \text{ standard errors} $$

    The solid line is the lowest value of all points $x_i$ that were evaluated until then. Where the
    solver takes a batch of samples a step, the smoothed function at its iterates $y_t$ is drawn
    too, with a 95 % band. The dot is the answer. The axis of values is logarithmic if none is
    negative and they span a factor of ten.

    Args:
        result: what `minimise` or `least_squares` returned.
        ax: the matplotlib axes to draw into, by default new ones.
        against: "evaluations" of the function, or "seconds" since the start.

    Returns:
        The axes.

    Raises:
        ValueError: another word for `against`; a run without a step.

    Example:
        >>> import jax, jax.numpy as jnp, matplotlib.figure, optax, smoothdiff as sd
        >>> fun = lambda y, args: jnp.sum(jnp.floor(4 * jnp.abs(y)))
        >>> solver = sd.FirstOrder(optax.adam(0.05), 0.2)
        >>> result = sd.minimise(fun, jnp.ones(2), key=jax.random.key(0), solver=solver)
        >>> ax = sd.plot.history(result, ax=matplotlib.figure.Figure().subplots())
        >>> ax.get_xlabel()
        'evaluations'

    Source: own.
    """
    if against not in ("evaluations", "seconds"):
        raise ValueError(f'against must be "evaluations" or "seconds", not {against!r}')
    records = result.history
    if not records:
        raise ValueError("the run made no step, so there is nothing to plot: print the result")
    x = np.asarray([getattr(record, against) for record in records], float)
    fun, smoothed, stderr = np.asarray([(r.fun, r.smoothed, r.stderr) for r in records]).T
    end = float(result.evaluations) if against == "evaluations" else x[-1]
    ax = _new_axes(1)[0] if ax is None else ax
    shown, estimated = [np.asarray([result.fun])], np.isfinite(stderr)
    if np.any(estimated):
        at, value, error = x[estimated], smoothed[estimated], stderr[estimated]
        if math.isfinite(result.smoothed) and math.isfinite(result.stderr):
            at, value = np.append(at, end), np.append(value, result.smoothed)
            error = np.append(error, result.stderr)
        _band(ax, at, value, _WITHIN * error)
        shown.append(value)
    known = np.isfinite(fun)
    if np.any(known):
        at, value = np.append(x[known], end), np.append(fun[known], fun[known][-1])
        ax.step(at, value, where="post", color=_FUNCTION, lw=1.2, label="lowest so far")
        shown.append(value)
    ax.plot([end], [result.fun], "o", color=_ANSWER, ms=5, label="answer", zorder=3)
    _log_if_it_helps(ax, np.concatenate(shown))
    ax.set_xlabel("evaluations" if against == "evaluations" else "time (s)")
    ax.set_ylabel("function")
    ax.legend(frameon=False, fontsize="small")
    return _clean(ax)


def slice(
    fun: Callable[[PyTree, PyTree], Any],
    y: PyTree,
    args: PyTree = None,
    *,
    sigma: PyTree = None,
    key: Any,
    parameter: int | str | None = None,
    space: PyTree = None,
    labels: Sequence[str] | None = None,
    points: int = 41,
    num_samples: int = 64,
    ax: Any = None,
) -> Any:
    r"""The function along one parameter through a point, and the smoothed one along the same line.

    $$ t \mapsto f(y + t e_j) \quad\text{and}\quad
       t \mapsto \mathbb{E}_z[f(y + t e_j + \sigma z)] $$

    It shows whether a point is a minimum, whether sigma bridges steps and ripples, and whether a
    parameter matters at all. The band is a 95 % interval. All points of a line share their random
    numbers: an error moves the line as a whole, and does not make it rough. Each point takes
    `num_samples` + 1 evaluations.

    Args:
        fun: the function, `fun(y, args)`, which returns one number, as for `minimise`. May contain
            a black box.
        y: the point, such as `result.y`: a pytree of numbers and arrays, in natural values.
        args: passed on to `fun`.
        sigma: the smoothing width of all parameters, as for `smooth`. With a space it is in unit
            coordinates, and by default the width that the space has.
        key: a random key.
        parameter: which number of `y` to vary, by its position among all of them or by its label.
            By default each in turn, on axes of its own.
        space: what the parameters may be, as for `minimise`. A parameter is drawn over its whole
            range or period, and if it has neither, over four sigma to either side.
        labels: names for the numbers of `y`, with units; by default those of the spaces, or of the
            pytree.
        points: how many points a line has.
        num_samples: samples of the smoothed function at each, a multiple of 4.
        ax: the matplotlib axes to draw into, by default new ones; a sequence of them for more than
            one parameter.

    Returns:
        The axes, an array of them if `parameter` is None.

    Raises:
        ValueError: no such parameter; too many to show; labels or axes of another number.
        TypeError: a function that does not return one number.

    Example:
        >>> import jax, jax.numpy as jnp, matplotlib.figure, smoothdiff as sd
        >>> stairs = lambda y, args: jnp.sum(jnp.floor(jnp.abs(y)))
        >>> ax = sd.plot.slice(
        ...     stairs, jnp.array([3.0, 1.0]), key=jax.random.key(0), parameter=0,
        ...     space=sd.Range(-9, 9), labels=["x (m)", "y (m)"],
        ...     ax=matplotlib.figure.Figure().subplots(),
        ... )
        >>> ax.get_xlabel()
        'x (m)'

    Source: own.
    """
    lines = Slices.of(fun, y, args, sigma, key, space, labels, points, num_samples)
    chosen = lines.all() if parameter is None else [lines.position(parameter)]
    if ax is None:
        axes = _new_axes(len(chosen))
    else:
        axes = [ax] if parameter is not None else list(np.ravel(ax))
    if len(axes) != len(chosen):
        raise ValueError(f"ax has {len(axes)} axes for {len(chosen)} parameters")
    for j, axis in zip(chosen, axes, strict=True):
        line = lines.along(j)
        _band(axis, line.x, line.smoothed, line.error)
        style = "steps-mid" if line.whole else "default"
        axis.plot(line.x, line.fun, color=_FUNCTION, lw=1.2, ds=style, label="function")
        here = line.x[line.here], line.fun[line.here]
        axis.plot(*here, "o", color=_ANSWER, ms=5, label="here", zorder=3)
        axis.set_xscale(line.scale)
        axis.set_xlabel(lines.labels[j])
        _clean(axis)
    axes[0].set_ylabel("function")
    if ax is None and len(axes) > 1:
        handles = axes[0].get_legend_handles_labels()
        axes[0].figure.legend(
            *handles, frameon=False, fontsize="small", loc="outside upper right", ncols=3
        )
    else:
        axes[0].legend(frameon=False, fontsize="small")
    return axes[0] if parameter is not None else np.asarray(axes)


def errors(
    values: PyTree | Result,
    stderrs: PyTree = None,
    labels: Sequence[str] | None = None,
    ax: Any = None,
) -> Any:
    r"""Parameters with their 95 % intervals, one under the other.

    $$ y_j \pm 1.96 \, s_j $$

    Args:
        values: a `Result` of `least_squares`, which is drawn with its `parameter_intervals`; or the
            parameters, a pytree of numbers and arrays.
        stderrs: the standard errors of such parameters, a pytree like them. A parameter whose error
            is not finite is drawn without an interval.
        labels: a name for each number, with its unit; by default from the space, or the pytree.
        ax: the matplotlib axes to draw into, by default new ones.

    Returns:
        The axes.

    Raises:
        ValueError: another number of standard errors or labels than of values; parameters without
            standard errors, or a result that has none; standard errors of another structure, or
            negative ones.

    Example:
        >>> import matplotlib.figure, smoothdiff as sd
        >>> ax = sd.plot.errors(
        ...     {"mass": 2.0, "drag": 0.3}, {"mass": 0.5, "drag": 0.02},
        ...     ax=matplotlib.figure.Figure().subplots(),
        ... )
        >>> [tick.get_text() for tick in ax.get_yticklabels()]
        ['drag', 'mass']

    Source: own.
    """
    if isinstance(values, Result):
        if stderrs is not None:
            raise ValueError("a result has its own errors: leave out stderrs")
        low, high = (_flat(end) for end in values.parameter_intervals())
        units = UnitSpace.of(values.y, None) if values.answer is None else values.answer.units
        usual, y = units.labels(), _flat(values.y)
    else:
        usual, y, s = UnitSpace.of(values, None).labels(), _flat(values), _flat(stderrs)
        if len(s) != len(y):
            raise ValueError(
                f"there are {len(s)} standard errors for {len(y)} values: give one for each"
            )
        if jax.tree.structure(stderrs) != jax.tree.structure(values):
            raise ValueError(
                f"stderrs must be a pytree like the values, {jax.tree.structure(values)}, not "
                f"{jax.tree.structure(stderrs)}"
            )
        if np.any(s < 0):
            raise ValueError(f"a standard error is negative: {np.min(s)}")
        low, high = y - _WITHIN * s, y + _WITHIN * s
    labels = usual if labels is None else list(labels)
    if len(labels) != len(y):
        raise ValueError(f"there are {len(labels)} labels for {len(y)} values: give one for each")
    ax = _new_axes(1)[0] if ax is None else ax
    rows, known = np.arange(len(y)), np.isfinite(high - low)
    ax.hlines(rows[known], low[known], high[known], color="0.75", lw=3)
    ax.plot(y, rows, "o", color=_FUNCTION, ms=5)
    ax.set_yticks(rows, labels)
    ax.set_ylim(len(y) - 0.5, -0.5)
    ax.set_xlabel("value and 95 % interval")
    _clean(ax).grid(visible=False, axis="y")
    return ax


def _band(ax: Any, x: np.ndarray, value: np.ndarray, error: np.ndarray) -> None:
    ax.fill_between(x, value - error, value + error, color=_BAND, lw=0)
    ax.plot(x, value, color=_SMOOTHED, lw=1.2, label="smoothed")


def _log_if_it_helps(ax: Any, values: np.ndarray) -> None:
    positive = values[values > 0]
    if np.all(values >= 0) and len(positive) and positive.max() > 10 * positive.min():
        ax.set_yscale("log", nonpositive="clip")
        # a band that reaches zero must not stretch the axis
        ax.set_ylim(bottom=positive.min() / 2)


def _clean(ax: Any) -> Any:
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(color="0.93", lw=0.6)
    ax.set_axisbelow(True)
    return ax


def _new_axes(number: int) -> list:
    import matplotlib.pyplot as plt

    columns = min(number, _ABREAST)
    rows = -(-number // columns)
    size = (4.8, 3.2) if number == 1 else (2.4 * columns, 2.1 * rows)
    figure = plt.figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
    for axis in axes[number:]:
        axis.set_visible(False)
    return list(axes[:number])


def _flat(tree: PyTree) -> np.ndarray:
    leaves = [np.ravel(np.asarray(leaf, float)) for leaf in jax.tree.leaves(tree)]
    return np.concatenate(leaves) if leaves else np.zeros(0)
