"""`renderer`: a Mitsuba 3 scene as a JAX function, by black box: parameters in, linear RGB out."""

import hashlib
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from smoothdiff._black_box import black_box
from smoothdiff._params import as_key
from smoothdiff.renderers._mitsuba_scene import (
    Axis,
    Scene,
    as_motion,
    check_variant,
    initial_value,
    mi,
    mitsuba_with,
    scene_values,
)

# What says how many pixels a film has, and which of them are rendered.
_WINDOW = "size", "crop_size", "crop_offset"


def renderer(
    scene: Any,
    params: str | Sequence[str],
    *,
    axis: Axis | Mapping[str, Axis | None] | None = None,
    resolution: int | tuple[int, int] | None = None,
    spp: int | None = None,
    integrator: Any = None,
    sensor: int | Sequence[int] = 0,
    variant: str | None = None,
    seed: int = 0,
    noise: str = "fixed",
    on_error: str = "raise",
    on_nonfinite: str = "raise",
) -> "Renderer":
    """Makes a JAX function that renders a Mitsuba scene for given values of some of its parameters.

    The function is a `smoothdiff.black_box`: it works under `jit`, `vmap`, `scan` and every
    smoothdiff transform, and has no derivative of its own. The image depends on nothing but the
    parameters, and on a key if one is given: `render(y, key)`, as `minimise` with `takes_key=True`
    does. Parameters that are not finite, and a scale that is not positive, give an image of NaN:
    an error, or with `on_nonfinite="nan"` and `nonfinite="drop"` of a solver a dropped sample.

    Args:
        scene: A dict as for `mitsuba.load_dict`, the path of an XML file, or a loaded scene. A
            loaded one is changed in place; load it with `optimize=False`, or meshes are merged.
        params: What to vary: one name, and the function takes an array; or a sequence of names, and
            it takes a dict from name to array. A name is a key of `mitsuba.traverse(scene)`, such
            as `"ball.bsdf.reflectance.value"` or `"lamp.position"`, with the shape that the value
            has there; or a motion of a shape, camera or light, from where the scene has it:
            `"ball.translate"` (3 numbers, scene units), `"ball.rotate"` (radians: 1 number about
            an `axis`, without one 3 numbers, a rotation vector in world space), `"ball.scale"` (1
            number, a positive factor: give bounds or `sd.Positive()`). Objects are scaled, then
            rotated, then translated; the first two about their own origin, which is the translation
            of their `to_world` or, for a mesh without one, the centre of its bounding box. So a
            camera's pose is `["camera.translate", "camera.rotate"]`, its field of view
            `"camera.x_fov"` (degrees), and what an orthographic one sees `"camera.scale"`.
        axis: Direction in world space that `"NAME.rotate"` turns about, anti-clockwise for a viewer
            that it points at; or a dict from object to direction, `{"mug": (0, 0, 1)}`. Others
            turn about any.
        resolution: Pixels, `(height, width)` or the side of a square. None: as the scene says. Of
            a film with a crop window it is that of the window, which is rounded to whole pixels.
        spp: Samples per pixel. None: as the scene says.
        integrator: The type of a Mitsuba integrator, such as `"direct"`, a dict as for
            `mitsuba.load_dict`, or a loaded integrator. None: as the scene says.
        sensor: The index of a camera, or of several, whose images are stacked along a first axis.
        variant: Mitsuba variant. None: that of a loaded scene, or `"scalar_rgb"`, which needs
            nothing but Mitsuba. See `available`. The variant is global to the process, and set
            whenever an image is rendered; to change it from image to image takes 0.1 s.
        seed: Seed of the render noise, from 0 to 2**32 - 1.
        noise: `"fixed"`: the same noise in every image (common random numbers). `"per_params"`:
            other parameters have other noise; the same ones still give the same image.
        on_error: As in `smoothdiff.black_box`.
        on_nonfinite: As in `smoothdiff.black_box`.

    Returns:
        A `Renderer`: `render(params)` is the image, linear RGB, float32, of shape (height, width,
        3); `render.initial` are the parameters that the scene came with.

    Raises:
        ValueError: If the scene has no such parameter, or an argument is out of range.
        RuntimeError: If the variant cannot run on this machine.

    Example:
        >>> import jax
        >>> from smoothdiff.renderers import mitsuba
        >>> scene = {"type": "scene", "ball": {"type": "sphere"}, "sky": {"type": "constant"},
        ...          "camera": {"type": "perspective"}}
        >>> render = mitsuba.renderer(scene, "ball.translate", resolution=8, integrator="direct")
        >>> render.initial
        Array([0., 0., 0.], dtype=float32)
        >>> jax.jit(render)(jax.numpy.array([0.0, 0.0, 5.0])).shape
        (8, 8, 3)

    Source: own; the renderer is Mitsuba 3 (Jakob et al., 2022).
    """
    names = (params,) if isinstance(params, str) else tuple(params)
    if not names or len(set(names)) < len(names):
        raise ValueError(f"params must name at least one parameter, each once; got {params!r}")
    if noise not in ("fixed", "per_params"):
        raise ValueError(f'noise must be "fixed" or "per_params", not {noise!r}')
    if not 0 <= operator.index(seed) < 2**32:
        raise ValueError(f"seed must be from 0 to 2**32 - 1, not {seed}")
    if spp is not None and operator.index(spp) < 1:
        raise ValueError(f"spp must be at least 1, or None for what the scene says, not {spp}")
    variant = check_variant(variant, scene)
    seed, single = operator.index(seed), np.ndim(sensor) == 0
    views = [operator.index(view) for view in np.atleast_1d(sensor).tolist()]

    with mitsuba_with(variant):
        loaded = Scene.of(scene)
        integrator = _integrator(loaded, integrator)
        axes = _axes(loaded, names, axis)
        initial = {name: initial_value(loaded, name, axes) for name in names}
        scene_values(loaded, initial, axes)  # raises if two names speak of the same thing
        films, size = _films(loaded, views, resolution)
        scales = [name for name in names if (as_motion(loaded, name) or ("", ""))[1] == "scale"]
    shape = size if single else (len(views), *size)

    def render(values: dict[str, np.ndarray], drawn_seed: np.ndarray | None) -> np.ndarray:
        nowhere = not all(np.isfinite(value).all() for value in values.values())
        if nowhere or not all(np.all(values[name] > 0) for name in scales):
            # Mitsuba leaves out a shape that is nowhere, and what remains looks like a picture. A
            # shape that was turned inside out may stay so.
            return np.full(shape, np.nan, np.float32)
        noise_seed: Any = seed if noise == "fixed" else _hash(seed, values)
        if drawn_seed is not None:
            noise_seed = int(drawn_seed)
        with mitsuba_with(variant):
            loaded.set(films | scene_values(loaded, values, axes))
            images = [
                np.array(
                    mi.render(
                        loaded.scene,
                        sensor=view,
                        integrator=integrator,
                        seed=noise_seed,
                        spp=spp or 0,
                    )
                )
                for view in views
            ]
        return images[0] if single else np.stack(images)

    box = black_box(
        render,
        jax.ShapeDtypeStruct(shape, jnp.float32),
        on_error=on_error,
        on_nonfinite=on_nonfinite,
    )
    return Renderer(box, initial, isinstance(params, str))


class Renderer:
    """A scene as a function of some of its parameters, made by `renderer`.

    Attributes:
        initial: The parameters that the scene came with, in the form that the function takes.

    Raises:
        ValueError: when it is called, parameters of other names or shapes.

    Example:
        >>> from smoothdiff.renderers import mitsuba
        >>> scene = {"type": "scene", "ball": {"type": "sphere"}, "sky": {"type": "constant"},
        ...          "camera": {"type": "perspective"}}
        >>> render = mitsuba.renderer(scene, ["ball.scale"], resolution=8, integrator="direct")
        >>> render(render.initial).shape
        (8, 8, 3)

    Source: own; the renderer is Mitsuba 3 (Jakob et al., 2022).
    """

    initial: Array | dict[str, Array]

    def __init__(self, box: Callable[..., Array], initial: dict[str, np.ndarray], single: bool):
        self._box = box
        self._shapes = {name: value.shape for name, value in initial.items()}
        self._single = single
        arrays = {name: jnp.asarray(value, jnp.float32) for name, value in initial.items()}
        self.initial = next(iter(arrays.values())) if single else arrays

    def __call__(self, params: Any, key: Any = None) -> Float[Array, "*views height width 3"]:
        """Renders the scene.

        Args:
            params: Like `initial`.
            key: A random key that decides the noise of this image, in place of `seed` and `noise`.

        Returns:
            The image, linear RGB, or one for each camera if several were asked for.

        Raises:
            ValueError: If a parameter is missing, unknown, or of the wrong shape, or a dict is
                given where there is one parameter.
        """
        if self._single and isinstance(params, Mapping):
            raise ValueError(f"params is {next(iter(self._shapes))!r} alone: give an array")
        values = dict.fromkeys(self._shapes, params) if self._single else params
        if not isinstance(values, Mapping) or set(values) != set(self._shapes):
            got = list(values) if isinstance(values, Mapping) else type(values).__name__
            raise ValueError(f"params must be a dict with keys {list(self._shapes)}, got {got}")
        arrays = {name: jnp.asarray(values[name]) for name in self._shapes}
        for name, array in arrays.items():
            if array.shape != self._shapes[name] or jnp.iscomplexobj(array):
                raise ValueError(
                    f"{name!r} must be real numbers of shape {self._shapes[name]}, "
                    f"got {array.dtype} of shape {array.shape}"
                )
        drawn_seed = None if key is None else jax.random.bits(as_key(key), (), jnp.uint32)
        values = {name: array.astype(jnp.float32) for name, array in arrays.items()}
        return self._box(values, drawn_seed)


def _hash(seed: int, values: Mapping[str, np.ndarray]) -> int:
    """A seed that follows from another and from the bits of the parameters."""
    bits = hashlib.blake2b(seed.to_bytes(4, "little"), digest_size=4)
    for name in sorted(values):
        bits.update(values[name].tobytes())
    return int.from_bytes(bits.digest(), "little")


def _integrator(loaded: Scene, integrator: Any) -> Any:
    """The integrator to render with, loaded."""
    if integrator is None:
        integrator = loaded.scene.integrator()
    if integrator is None:
        raise ValueError('the scene has no integrator; name one, such as integrator="path"')
    if isinstance(integrator, str):
        integrator = {"type": integrator}
    return mi.load_dict(integrator) if isinstance(integrator, dict) else integrator


def _axes(
    loaded: Scene,
    names: Sequence[str],
    axis: Axis | Mapping[str, Axis | None] | None,
) -> dict[str, Axis]:
    """Unit vectors by object, for those that rotate about one."""
    axes = {}
    things = {name.rpartition(".")[0] for name in loaded.names}
    if unknown := (set(axis) if isinstance(axis, Mapping) else set()) - things:
        raise ValueError(f"axis names {sorted(unknown)}, of which the scene has nothing")
    for thing, motion in filter(None, (as_motion(loaded, name) for name in names)):
        chosen = axis.get(thing) if isinstance(axis, Mapping) else axis
        if motion == "rotate" and chosen is not None:
            direction = np.asarray(chosen, float)
            if direction.shape != (3,) or not np.linalg.norm(direction) > 0:
                raise ValueError(
                    f"'{thing}.rotate' turns about axis=(x, y, z) or axis={{{thing!r}: (x, y, z)}},"
                    f" and without it about any; got {axis}"
                )
            axes[thing] = (direction / np.linalg.norm(direction)).tolist()
    return axes


def _films(
    loaded: Scene, views: Sequence[int], resolution: int | tuple[int, int] | None
) -> tuple[dict[str, np.ndarray], tuple[int, int, int]]:
    """What to set for these cameras to have this resolution, and the shape of an image."""
    sensors = loaded.scene.sensors()
    if not views or not all(0 <= view < len(sensors) for view in views):
        raise ValueError(f"the scene has {len(sensors)} sensor(s), and there is no {views} in it")
    for film in (sensors[view].film() for view in views):
        if film.base_channels_count() != 3:
            raise ValueError("the film must have pixel_format 'rgb'")
    # Mitsuba lists the films in the order of their cameras.
    films = [key.removesuffix(".size") for key in loaded.names if key.endswith("film.size")]
    films = [films[view] for view in views]
    sizes = {tuple(loaded.initial(f"{film}.crop_size").tolist()) for film in films}
    if resolution is None:
        if len(sizes) > 1:
            raise ValueError(f"the cameras differ in size, {sizes}: choose one resolution for all")
        width, height = sizes.pop()
        return {}, (height, width, 3)
    height, width = np.broadcast_to(resolution, 2).tolist()
    if not (operator.index(height) > 0 and operator.index(width) > 0):
        raise ValueError(f"resolution must be positive, not {resolution}")
    wanted = np.array([width, height])
    values = {}
    for film in films:
        size, window, offset = (loaded.initial(f"{film}.{part}") for part in _WINDOW)
        scale = wanted / window
        offset = np.round(scale * offset).astype(int)
        size = np.maximum(np.round(scale * size).astype(int), offset + wanted)
        # told of the size alone, Mitsuba would take the whole film
        parts = zip(_WINDOW, (size, wanted, offset), strict=True)
        values |= {f"{film}.{part}": value for part, value in parts}
    return values, (height, width, 3)
