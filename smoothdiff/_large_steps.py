"""Large Steps as an optax transformation: Adam with Laplacian smoothing before and after."""

from typing import Any

import optax

from smoothdiff._filtered_adam import filtered_adam
from smoothdiff.filters.grid import Scale
from smoothdiff.filters.mesh import mesh_laplacian


def large_steps(
    learning_rate: optax.ScalarOrSchedule,
    faces: Any,
    lam: int | float,
    b1: Scale = 0.9,
    b2: Scale = 0.999,
    eps: Scale = 1e-8,
) -> optax.GradientTransformationExtraArgs:
    r"""Moves the vertices of a mesh in steps that are smooth on its surface.

    $$ \begin{aligned}
       u_t &= (I + \lambda L)^{-1} g_t, &
       m_t &= \beta_1 m_{t-1} + (1 - \beta_1) u_t, &
       v_t &= \beta_2 v_{t-1} + (1 - \beta_2) u_t^2, \\
       & & x_{t+1} &= x_t - \alpha \frac{(I + \lambda L)^{-1} m_t / (1 - \beta_1^t)}
                      {\sqrt{\max v_t / (1 - \beta_2^t)} + \epsilon}
       \end{aligned} $$

    L is the Laplacian of the mesh, as in `filters.mesh_laplacian`. These are the steps of
    AdamUniform on the variable (I + λL) x, without that variable. In other words: `filtered_adam`
    with `mesh_laplacian` before and after, and with the largest second moment for all vertices. To
    keep creases, make it of `filtered_adam` with `mesh_bilateral` as the `postfilter`.

    Args:
        learning_rate: α, about how far the vertices move in one step, in the units of the
            positions: a number or an optax schedule.
        faces: (faces, 3), which vertices each triangle has. With `optax.inject_hyperparams`, name
            faces and lam in its static_args.
        lam: λ, how far steps are smoothed: over about √λ edges. The paper has 19; at most 1e10.
        b1: β1, how much of the first moment a step keeps.
        b2: β2, how much of the second moment a step keeps. With b1 = b2 = 0 there is no state.
        eps: ε, keeps the division from zero.

    Returns:
        An optax transformation for positions (vertices, 3). For other leaves in the same pytree,
        choose the positions with `optax.masked` or `optax.multi_transform`.

    Raises:
        ValueError: faces or a lam that `mesh_laplacian` refuses; in `update`, no parameters.

    Example:
        >>> import jax, jax.numpy as jnp, optax, smoothdiff as sd
        >>> tetrahedron = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]
        >>> x = jnp.array([[1.0, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]])
        >>> optimiser = sd.large_steps(0.1, tetrahedron, lam=19.0)
        >>> gradient = jax.grad(lambda x: x[0, 0] ** 2)(x)
        >>> updates, state = optimiser.update(gradient, optimiser.init(x), x)
        >>> optax.apply_updates(x, updates).shape
        (4, 3)

    Source: Spatiotemporal Bilateral Gradient Filtering for Inverse Rendering, Algorithm 3; Large
    Steps in Inverse Rendering of Geometry (2021), with the bias correction of its AdamUniform.
    """
    smooth = mesh_laplacian(faces, lam)
    return filtered_adam(
        learning_rate,
        b1=b1,
        b2=b2,
        eps=eps,
        prefilter=smooth,
        postfilter=smooth,
        second_moment="max",
    )
