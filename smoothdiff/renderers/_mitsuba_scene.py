"""Mitsuba on the host: variants, and a loaded scene whose parameters are set by name.

What is global or mutable in Mitsuba (one variant a process, scenes that are changed in place) is
dealt with here, so that an image depends on nothing but the parameters that it was asked for.
"""

import contextlib
import difflib
import os
import threading
import weakref
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, TypeAlias

import numpy as np

try:
    import drjit as dr
    import mitsuba as mi
except ImportError as error:
    raise ImportError("this renderer needs Mitsuba 3: pip install smoothdiff[mitsuba]") from error

# Mitsuba's variant is global to the process, and Dr.Jit hangs or aborts when two threads use it at
# once: whoever touches Mitsuba holds this lock, from setting the variant to copying out the image.
_LOCK = threading.RLock()

# Older ones cannot be loaded, or abort the process at the first kernel.
_MIN_LLVM = 17

Axis: TypeAlias = Sequence[int | float]

# Values of the motions when the object stays where the scene has it; with an axis a rotation has
# one number.
_MOTIONS = {
    "translate": np.zeros(3, np.float32),
    "rotate": np.zeros(3, np.float32),
    "scale": np.ones((), np.float32),
}


def available(variant: str) -> bool:
    """Whether a Mitsuba variant can run on this machine, found out without risking the process.

    The `scalar_*` variants run wherever Mitsuba can be imported; `llvm_*` also need a system LLVM
    of version 17 or newer, `cuda_*` an NVIDIA driver.

    Args:
        variant: The name of a Mitsuba variant, such as `"llvm_ad_rgb"`.

    Returns:
        True if `renderer(..., variant=variant)` can be used.

    Example:
        >>> from smoothdiff.renderers import mitsuba
        >>> mitsuba.available("scalar_rgb")
        True

    Source: own; the renderer is Mitsuba 3 (Jakob et al., 2022).
    """
    if variant.startswith("llvm"):
        # Loading an old LLVM is harmless, compiling with it is not: ask only for its version.
        able = dr.has_backend(dr.JitBackend.LLVM) and dr.detail.llvm_version() >= (_MIN_LLVM,)
    else:
        able = not variant.startswith("cuda") or dr.has_backend(dr.JitBackend.CUDA)
    return variant in mi.variants() and bool(able)


def check_variant(variant: str | None, scene: Any) -> str:
    """The variant to render a scene with, once it is known to be safe."""
    own = scene.variant_name() if hasattr(scene, "variant_name") else None
    variant = variant or own or "scalar_rgb"
    if own not in (None, variant):
        raise ValueError(f"the scene was loaded for variant {own}, so leave out {variant=}")
    if variant not in mi.variants():
        raise ValueError(f"variant must be one of {', '.join(mi.variants())}; got {variant!r}")
    if not available(variant):
        llvm = f"LLVM {_MIN_LLVM} or newer (on Debian or Ubuntu: apt-get install libllvm19)"
        need = llvm if variant.startswith("llvm") else "an NVIDIA driver"
        raise RuntimeError(
            f'the variant {variant} cannot run here: install {need}, or use variant="scalar_rgb", '
            "which needs nothing but Mitsuba"
        )
    return variant


@contextlib.contextmanager
def mitsuba_with(variant: str) -> Iterator[None]:
    """Holds Mitsuba, set to this variant.

    The variant stays afterwards, as Mitsuba's own `set_variant` does: a change can take 0.1 s.
    """
    with _LOCK:
        mi.set_variant(variant)
        yield


class Scene:
    """A loaded scene, what its parameters were at first, and what they are now.

    To be used within `mitsuba_with` the variant of the scene.
    """

    # Renderers that were given the same loaded scene must know of each other's changes. By the id
    # of the Mitsuba scene (to which there are no weak references), which its entry keeps alive.
    _known: ClassVar[weakref.WeakValueDictionary] = weakref.WeakValueDictionary()

    def __init__(self, scene: Any):
        self.scene = scene
        self._parameters = mi.traverse(scene)
        self.names = self._parameters.keys()
        self._initial: dict[str, np.ndarray] = {}
        self._current: dict[str, np.ndarray | None] = {}

    @classmethod
    def of(cls, scene: Any) -> "Scene":
        """From a dict, a path or a loaded scene."""
        # Without optimize=False, meshes that share a material are merged and lose their names.
        if isinstance(scene, dict):
            scene = mi.load_dict(scene, optimize=False)
        elif isinstance(scene, str | os.PathLike):
            scene = mi.load_file(os.fspath(scene), optimize=False)
        if not isinstance(scene, mi.Scene):
            raise TypeError(
                f"scene must be a dict with type 'scene', a path or a mitsuba.Scene; got {scene!r}"
            )
        return cls._known.get(id(scene)) or cls._known.setdefault(id(scene), cls(scene))

    def initial(self, key: str) -> np.ndarray:
        """The value that the scene came with."""
        if key not in self._initial:
            self._initial[key] = _to_numpy(self._parameters[key])
        return self._initial[key]

    def set(self, values: Mapping[str, Any]):
        """Gives these parameters their values, and all others those that the scene came with.

        Mitsuba is told only of objects that differ from now, since an update can rebuild them. But
        it is told all that is wanted of them: given new positions only, it makes its own normals.
        """
        wanted: dict[str, dict[str, np.ndarray]] = {}
        for key in {*values, *self._current}:
            first = self.initial(key)
            value = np.asarray(values.get(key, first), first.dtype).reshape(first.shape)
            wanted.setdefault(key.rpartition(".")[0], {})[key] = value
        changed = {
            key: value
            for of_object in wanted.values()
            if any(self._differs(key, value) for key, value in of_object.items())
            for key, value in of_object.items()
        }
        if changed:
            # Should the update fail, what the scene holds is unknown, and is to be set again.
            self._current.update(dict.fromkeys(changed))
            for key, value in changed.items():
                self._parameters[key] = _to_mitsuba(value, self._parameters[key])
                self._parameters.set_dirty(key)  # also if it is the value that Mitsuba has
            self._parameters.update()
            self._current.update(changed)

    def _differs(self, key: str, value: np.ndarray) -> bool:
        now = self._current.get(key)
        return now is None or now.tobytes() != value.tobytes()


def initial_value(scene: Scene, name: str, axes: Mapping[str, Axis]) -> np.ndarray:
    """The value that a parameter starts from, be it the scene's own or a motion."""
    if motion := as_motion(scene, name):
        angle = motion[1] == "rotate" and motion[0] in axes
        return np.zeros((), np.float32) if angle else _MOTIONS[motion[1]]
    if name in scene.names and _is_float(scene.initial(name)):
        return scene.initial(name)
    names = [key for key in scene.names if _is_float(scene.initial(key))]
    things = dict.fromkeys(key.rpartition(".")[0] for key in scene.names)
    motions = [f"{thing}.{motion}" for thing in things for motion in _MOTIONS]
    names += [name for name in motions if as_motion(scene, name)]
    close = difflib.get_close_matches(name, names)
    raise ValueError(
        f"the scene has no parameter {name!r} made of real numbers. "
        + (f"Did you mean {' or '.join(map(repr, close))}? " if close else "")
        + f"It has: {', '.join(names)}. (Objects of an XML file need an id to be named.)"
    )


def as_motion(scene: Scene, name: str) -> tuple[str, str] | None:
    """The object and the kind of motion that a name stands for, if it does."""
    thing, _, motion = name.rpartition(".")
    if name in scene.names:
        return None  # the object has a parameter of that name, as a light of the sky its scale
    places = {f"{thing}.to_world", f"{thing}.vertex_positions"}
    return (thing, motion) if motion in _MOTIONS and not places.isdisjoint(scene.names) else None


def scene_values(
    scene: Scene, values: Mapping[str, np.ndarray], axes: Mapping[str, Axis]
) -> dict[str, np.ndarray]:
    """The scene's own parameters for given ones, motions among them.

    Args:
        scene: The scene.
        values: By name.
        axes: Unit vector by name of the object, for those that rotate about one.
    """
    own, moving = {}, {}
    for name, value in values.items():
        if motion := as_motion(scene, name):
            moving.setdefault(motion[0], {})[motion[1]] = value
        else:
            own[name] = value
    for thing, motions in moving.items():
        if thing in axes and "rotate" in motions:
            motions["rotate"] = motions["rotate"] * np.asarray(axes[thing])
        moved = _move(scene, thing, **(_MOTIONS | motions))
        if clash := own.keys() & moved.keys():
            raise ValueError(f"{clash} cannot be varied together with motions of {thing!r}")
        own |= moved
    return own


def _move(
    scene: Scene,
    thing: str,
    translate: np.ndarray,
    rotate: np.ndarray,
    scale: np.ndarray,
) -> dict[str, np.ndarray]:
    """An object from where the scene came with it, scaled, then rotated, then translated."""
    angle = np.linalg.norm(rotate)
    axis = (rotate / angle).tolist() if angle > 0 else (0, 0, 1)
    turn = mi.ScalarTransform4f().rotate(axis, float(np.degrees(angle)))
    rotation = np.array(turn.matrix, np.float64)[:3, :3]
    if f"{thing}.to_world" in scene.names:
        pose = scene.initial(f"{thing}.to_world").astype(np.float64)
        pose[:3, :3] = scale * rotation @ pose[:3, :3]
        pose[:3, 3] += translate
        return {f"{thing}.to_world": pose}
    points = scene.initial(f"{thing}.vertex_positions").reshape(-1, 3).astype(np.float64)
    normals = scene.initial(f"{thing}.vertex_normals").reshape(-1, 3)
    origin = (points.min(axis=0) + points.max(axis=0)) / 2
    return {
        f"{thing}.vertex_positions": scale * (points - origin) @ rotation.T + origin + translate,
        # Left to itself, Mitsuba computes new normals, which need not be those of the file.
        f"{thing}.vertex_normals": normals @ rotation.T,
    }


def _is_transform(value: Any) -> bool:
    return hasattr(type(value), "matrix")


def _is_float(value: np.ndarray) -> bool:
    return value.dtype.kind == "f"


def _to_numpy(value: Any) -> np.ndarray:
    """A parameter as an array; without the axis of length 1 that vectorised variants add."""
    if _is_transform(value):
        value = value.matrix
    array = np.array(value)
    if dr.is_jit_v(value) and not dr.is_tensor_v(value) and array.shape[-1] == 1:
        return array[..., 0]
    return array


def _to_mitsuba(value: np.ndarray, like: Any) -> Any:
    """The array as a parameter of the type of another."""
    parameter = type(like)(value if value.ndim else value.item())
    if _is_transform(like) and dr.is_jit_v(like.matrix):
        # Mitsuba compiles the numbers of some transforms into its kernel, anew for each pose.
        dr.make_opaque(parameter)
    return parameter
