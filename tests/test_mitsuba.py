"""The Mitsuba renderer: pictures as Mitsuba makes them, that follow from the parameters alone."""

from typing import Any

import jax
import jax.numpy as jnp
import mitsuba as mi
import numpy as np
import pytest

from benchmarks.scenes import shadow
from smoothdiff._host_samples import BlackBoxError
from smoothdiff.renderers import mitsuba
from smoothdiff.renderers._mitsuba_scene import mitsuba_with

mi.set_variant("scalar_rgb")
T = mi.ScalarTransform4f
BALL, CUBE, LAMP = (0.6, 0.0, 0.5), (-0.7, 0.2, 0.4), (1.0, -3.0, 4.0)
CUBE_TO_WORLD = T().translate(CUBE).rotate([0, 0, 1], 20).scale([0.4, 0.3, 0.2])


@pytest.fixture(autouse=True)
def scalar_rgb():
    """The variant for what a test asks of Mitsuba itself; rendering may have left another."""
    mi.set_variant("scalar_rgb")


def camera(**film):
    film = {"type": "hdrfilm", "width": 16, "height": 12, "rfilter": {"type": "box"}} | film
    look = T().look_at(origin=[0, -6, 3], target=[0, 0, 0.3], up=[0, 0, 1])
    return {"type": "perspective", "fov": 35, "to_world": look, "film": film}


def scene(**changes):
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.4, 0.3]}}
    tilt = T().translate([0.2, 0.8, 0.5]).rotate([1, 0, 0], 50).scale(0.6)
    return {
        "type": "scene",
        "integrator": {"type": "direct"},
        "camera": camera(),
        "ball": {"type": "sphere", "center": BALL, "radius": 0.4, "bsdf": grey},
        "cube": {"type": "cube", "to_world": CUBE_TO_WORLD, "bsdf": grey},
        "board": {"type": "rectangle", "to_world": tilt},
        "lamp": {"type": "point", "position": LAMP, "intensity": {"type": "rgb", "value": 20.0}},
    } | changes


def picture(changed_scene, spp=4):
    """What Mitsuba itself makes of a scene."""
    loaded = mi.load_dict(changed_scene, optimize=False)
    return np.array(mi.render(loaded, spp=spp))


# What the function is


def test_one_name_takes_an_array_and_several_a_dict():
    one = mitsuba.renderer(scene(), "ball.translate", spp=1)
    np.testing.assert_array_equal(one.initial, np.zeros(3))
    assert one(one.initial).shape == (12, 16, 3)

    names = ["ball.translate", "ball.scale", "board.rotate", "ball.bsdf.reflectance.value"]
    many = mitsuba.renderer(scene(), names, axis=(0, 0, 1), spp=1)
    assert isinstance(many.initial, dict)
    assert {k: v.shape for k, v in many.initial.items()} == dict(
        zip(names, [(3,), (), (), (3,)], strict=True)
    )
    np.testing.assert_allclose(many.initial[names[3]], [0.5, 0.4, 0.3], rtol=1e-6)
    np.testing.assert_allclose(many(many.initial), one(one.initial), atol=1e-6)

    listed = mitsuba.renderer(scene(), ["ball.translate"], spp=1)
    np.testing.assert_array_equal(listed(listed.initial), one(one.initial))


def test_jit_vmap_and_scan_give_what_eager_calls_give(key, dtype):
    render = mitsuba.renderer(scene(), ["ball.translate", "lamp.position"], resolution=8, spp=1)
    shifts = 0.3 * jax.random.normal(key, (4, 3), dtype)
    lamps = jax.vmap(lambda shift: shift + jnp.asarray(LAMP, dtype))(shifts)
    batch = {"ball.translate": shifts, "lamp.position": lamps}
    each = [{k: np.asarray(v)[i] for k, v in batch.items()} for i in range(4)]
    eager = np.stack([render(p) for p in each])
    assert eager.dtype == jnp.float32
    np.testing.assert_array_equal(jax.jit(jax.vmap(render))(batch), eager)
    _, scanned = jax.lax.scan(lambda c, p: (c, render(p)), None, batch)
    np.testing.assert_array_equal(scanned, eager)


def test_a_score_weighted_mean_has_the_gradient_that_its_samples_say(key):
    render = mitsuba.renderer(scene(), "ball.translate", resolution=8, spp=1)
    loss = lambda p: jnp.mean((render(p) - 0.1) ** 2)
    sigma, p0 = 0.2, jnp.array([0.1, 0.0, -0.1])
    z = jax.random.normal(key, (32, 3))
    points = jax.vmap(lambda z: p0 + sigma * z)(z)

    def smoothed(p):
        d = (p - p0) / sigma
        values = jax.lax.stop_gradient(jax.vmap(loss)(points))
        return jnp.mean(jnp.exp(z @ d - d @ d / 2) * values)

    values = np.asarray(jax.jit(jax.vmap(loss))(points))
    np.testing.assert_allclose(
        jax.jit(jax.grad(smoothed))(p0), values @ np.asarray(z) / len(z) / sigma, rtol=1e-4
    )
    assert jax.jit(jax.hessian(smoothed))(p0).shape == (3, 3)


# The right picture


def test_parameters_of_the_scene_are_set():
    names = ["lamp.position", "ball.bsdf.reflectance.value", "ball.to_world"]
    render = mitsuba.renderer(scene(), names, spp=4)
    moved = T().translate([0.1, 0.2, 0.9]).scale(0.3)
    values = {
        "lamp.position": jnp.array([-2.0, -3.0, 5.0]),
        "ball.bsdf.reflectance.value": jnp.array([0.1, 0.9, 0.2]),
        "ball.to_world": jnp.asarray(np.array(moved.matrix)),
    }
    green = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.1, 0.9, 0.2]}}
    lamp = scene()["lamp"] | {"position": [-2.0, -3.0, 5.0]}
    expected = scene(ball={"type": "sphere", "to_world": moved, "bsdf": green}, lamp=lamp)
    np.testing.assert_allclose(render(values), picture(expected), atol=1e-5)


def about(centre, motion):
    return T().translate(centre) @ motion @ T().translate([-c for c in centre])


MOTIONS = {
    "ball.translate": ([0.1, 0.2, 0.3], T().translate([0.1, 0.2, 0.3])),
    "ball.scale": (1.3, about(BALL, T().scale(1.3))),
    "board.translate": ([0.1, 0.2, 0.3], T().translate([0.1, 0.2, 0.3])),
    "board.rotate": (0.5, about((0.2, 0.8, 0.5), T().rotate([0, 1, 0], np.degrees(0.5)))),
    "board.scale": (0.7, about((0.2, 0.8, 0.5), T().scale(0.7))),
    "cube.translate": ([0.1, 0.2, 0.3], T().translate([0.1, 0.2, 0.3])),
    "cube.rotate": (0.5, about(CUBE, T().rotate([0, 1, 0], np.degrees(0.5)))),
    "cube.scale": (1.5, about(CUBE, T().scale(1.5))),
    "camera.translate": ([0.1, 0.2, 0.3], T().translate([0.1, 0.2, 0.3])),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_a_motion_moves_an_object_from_where_the_scene_has_it(name):
    value, motion = MOTIONS[name]
    thing = name.split(".")[0]
    description = scene()[thing]
    if thing == "ball":  # its description has no to_world
        before = T().translate(BALL).scale(0.4)
        description = {"type": "sphere", "bsdf": description["bsdf"]}
    else:
        before = description["to_world"]
    expected = picture(scene(**{thing: description | {"to_world": motion @ before}}))
    render = mitsuba.renderer(scene(), name, axis=(0, 3, 0), spp=4)
    assert np.abs(expected - render(render.initial)).max() > 0.01  # it is to be seen
    start = render(render.initial)
    np.testing.assert_allclose(start, picture(scene()), atol=1e-6)
    np.testing.assert_allclose(render(jnp.asarray(value)), expected, atol=1e-4)
    np.testing.assert_array_equal(render(render.initial), start)


def test_motions_are_scale_then_rotate_then_translate():
    names = ["cube.translate", "cube.rotate", "cube.scale"]
    render = mitsuba.renderer(scene(), names, axis={"cube": (1, 0, 1)}, spp=4)
    motion = T().translate([0.1, 0.2, 0.3]) @ about(
        CUBE, T().rotate([0.5**0.5, 0, 0.5**0.5], np.degrees(0.7)).scale(1.4)
    )
    expected = scene(cube=scene()["cube"] | {"to_world": motion @ CUBE_TO_WORLD})
    values = [jnp.array([0.1, 0.2, 0.3]), jnp.array(0.7), jnp.array(1.4)]
    actual = render(dict(zip(names, values, strict=True)))
    np.testing.assert_allclose(actual, picture(expected), atol=1e-4)


def turn(vector):
    angle = np.linalg.norm(vector)
    return T().rotate((vector / angle).tolist(), float(np.degrees(angle)))


def test_without_an_axis_a_rotation_is_a_vector():
    turns = mitsuba.renderer(scene(), ["cube.rotate", "board.rotate"], axis={"board": (0, 0, 1)})
    initial: Any = turns.initial
    assert {name: value.shape for name, value in initial.items()} == {
        "cube.rotate": (3,),
        "board.rotate": (),
    }
    start = turns(turns.initial)
    np.testing.assert_allclose(start, picture(scene(), spp=0), atol=1e-6)
    vector = np.array([0.3, -0.5, 0.4])
    motion = about(CUBE, turn(vector))
    expected = picture(scene(cube=scene()["cube"] | {"to_world": motion @ CUBE_TO_WORLD}), spp=0)
    turned = turns({"cube.rotate": jnp.asarray(vector), "board.rotate": jnp.array(0.0)})
    assert np.abs(expected - start).max() > 0.01
    np.testing.assert_allclose(turned, expected, atol=1e-4)


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_a_pose_of_a_camera_is_a_parameter(kind):
    def view(moved=None, fov=35.0, zoom=1.0):
        plain = camera()
        to_world = plain["to_world"] if moved is None else moved(plain["to_world"])
        if kind == "perspective":
            return {**plain, "fov": fov, "to_world": to_world}
        film = plain["film"]
        return {"type": kind, "film": film, "to_world": to_world @ T().scale([zoom, zoom, 1])}

    move, vector = [0.2, 0.1, -0.3], np.array([0.02, 0.05, 0.04])
    origin = [0, -6, 3]
    values = {"camera.translate": jnp.asarray(move), "camera.rotate": jnp.asarray(vector)}
    if kind == "perspective":
        values["camera.x_fov"], seen = jnp.array(30.0), {"fov": 30.0}
    else:
        values["camera.scale"], seen = jnp.array(1.2), {"zoom": 1.2}
    wanted = view(lambda pose: T().translate(move) @ about(origin, turn(vector)) @ pose, **seen)
    render = mitsuba.renderer(scene(camera=view()), list(values), spp=4)
    start = render(render.initial)
    np.testing.assert_allclose(start, picture(scene(camera=view())), atol=1e-6)
    expected = picture(scene(camera=wanted))
    assert np.abs(expected - start).max() > 0.01
    np.testing.assert_allclose(render(values), expected, atol=1e-4)


def test_a_mesh_keeps_the_normals_of_its_file():
    mesh = mi.load_dict({"type": "cube", "to_world": T().scale(0.5)})
    assert isinstance(mesh, mi.Mesh)
    mesh_parameters = mi.traverse(mesh)
    normals = np.array(mesh_parameters["vertex_normals"])
    leaning = normals.reshape(-1, 3) + np.array([0.3, -0.2, 0.1])
    mesh_parameters["vertex_normals"] = leaning.ravel().astype(np.float32)
    mesh_parameters.update()
    bent = scene(cube=mesh)
    expected = picture(bent)
    assert (
        np.abs(expected - picture(scene(cube=scene()["cube"] | {"to_world": T().scale(0.5)}))).max()
        > 0.01
    )

    for motion, value in (("cube.rotate", jnp.array(0.4)), ("cube.translate", jnp.full(3, 0.2))):
        render = mitsuba.renderer(bent, motion, axis=(0, 0, 1), spp=4)
        start = render.initial
        first, moved, again = render(start), render(value), render(start)
        np.testing.assert_array_equal(first, expected)
        np.testing.assert_array_equal(again, expected)
        assert np.abs(moved - expected).max() > 0.01


def test_resolution_spp_integrator_and_sensor():
    cameras = {"wide": camera(width=20, height=10), "cut": camera(crop_width=5, crop_height=4)}
    two = {k: v for k, v in scene().items() if k != "camera"} | cameras
    assert mitsuba.renderer(two, "ball.scale", spp=1)(1.0).shape == (10, 20, 3)
    assert mitsuba.renderer(two, "ball.scale", sensor=1, spp=1)(1.0).shape == (4, 5, 3)

    both = mitsuba.renderer(two, "ball.scale", sensor=[1, 0], resolution=(6, 8), spp=2)(1.0)
    assert both.shape == (2, 6, 8, 3)
    small = {k: v for k, v in two.items() if k != "cut"} | {"wide": camera(width=8, height=6)}
    np.testing.assert_array_equal(both[1], picture(small, spp=2))

    depth = mitsuba.renderer(scene(), "ball.scale", integrator="depth", spp=1)(1.0)
    assert depth.max() > 3
    path = mitsuba.renderer(scene(), "ball.scale", spp=4, integrator={"type": "path"})(1.0)
    expected = picture(scene(integrator={"type": "path"}))
    np.testing.assert_array_equal(path, expected)


XML = """<scene version="3.0.0">
  <integrator type="direct"/>
  <sensor type="perspective">
    <film type="hdrfilm">
      <integer name="width" value="9"/><integer name="height" value="7"/>
      <rfilter type="box"/>
    </film>
  </sensor>
  <shape type="sphere" id="ball"><point name="center" x="0" y="0" z="5"/></shape>
  <emitter type="point"><point name="position" x="3" y="3" z="0"/></emitter>
</scene>"""


def test_a_path_and_a_loaded_scene(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(XML)
    value = jnp.array([0.5, 0.0, 1.0])
    from_path = mitsuba.renderer(path, "ball.translate", spp=2)(value)
    loaded = mi.load_file(str(path), optimize=False)
    from_scene = mitsuba.renderer(loaded, "ball.translate", spp=2)(value)
    assert from_path.shape == (7, 9, 3)
    assert from_path.max() > 0
    np.testing.assert_array_equal(from_path, from_scene)
    resized = mitsuba.renderer(str(path), "ball.translate", resolution=5, spp=2)(value)
    assert resized.shape == (5, 5, 3)


# The picture follows from the parameters alone


def test_the_order_of_calls_does_not_matter(key):
    names = ["ball.translate", "cube.rotate", "lamp.position", "cube.vertex_texcoords"]
    render = mitsuba.renderer(scene(), names, axis=(0, 0, 1), resolution=8, spp=1)
    leaves, tree = jax.tree.flatten(render.initial)
    points = []
    for i in range(6):
        keys = jax.random.split(jax.random.fold_in(key, i), len(leaves))
        noise = [0.3 * jax.random.normal(k, x.shape) for k, x in zip(keys, leaves, strict=True)]
        points.append(tree.unflatten([x + n for x, n in zip(leaves, noise, strict=True)]))
    there = [render(p) for p in points]
    back = [render(p) for p in reversed(points)]
    np.testing.assert_array_equal(jnp.stack(there), jnp.stack(back[::-1]))


def test_renderers_of_one_loaded_scene_do_not_disturb_each_other():
    loaded = mi.load_dict(scene(), optimize=False)
    first = mitsuba.renderer(loaded, ["ball.translate", "cube.scale"], resolution=8, spp=1)
    start = first(first.initial)
    first({"ball.translate": jnp.ones(3), "cube.scale": 3.0})
    second = mitsuba.renderer(loaded, "ball.to_world", resolution=8, spp=1)
    np.testing.assert_array_equal(second(second.initial), start)
    np.testing.assert_array_equal(first(first.initial), start)
    full = mitsuba.renderer(loaded, "lamp.position", spp=4)
    np.testing.assert_allclose(full(full.initial), picture(scene()), atol=1e-6)


def test_only_what_changed_is_updated(monkeypatch):
    render = mitsuba.renderer(scene(), ["ball.translate", "cube.scale"], resolution=8, spp=1)
    told = []
    setitem = mi.SceneParameters.__setitem__

    def spy(self, name, value):
        told.append(name)
        setitem(self, name, value)

    monkeypatch.setattr(mi.SceneParameters, "__setitem__", spy)
    render({"ball.translate": jnp.zeros(3), "cube.scale": 1.0})
    assert len(told) == 6  # the film's window, the ball, and positions and normals of the cube
    for shift, expected in ((0.1, ["ball.to_world"]), (0.1, []), (0.2, ["ball.to_world"])):
        told.clear()
        render({"ball.translate": jnp.full(3, shift), "cube.scale": 1.0})
        assert told == expected


def test_noise_is_fixed_or_follows_from_the_parameters():
    # what lies beyond the far clip does not matter to the picture
    sky = scene(sky={"type": "constant"})
    near, far = jnp.float32(1000), jnp.float32(2000)
    make = lambda **kwargs: mitsuba.renderer(sky, "camera.far_clip", resolution=8, spp=1, **kwargs)
    fixed, other, fresh = make(), make(seed=2**32 - 1), make(noise="per_params")
    np.testing.assert_array_equal(fixed(near), fixed(far))
    assert (fixed(near) != other(near)).any()
    first = fresh(near)
    assert (first != fresh(far)).any()
    np.testing.assert_array_equal(first, fresh(near))
    assert (first != make(noise="per_params", seed=1)(near)).any()


def test_a_key_decides_the_noise_whatever_else_is_said():
    sky = scene(sky={"type": "constant"})
    near, keys = jnp.float32(1000), jax.random.split(jax.random.key(0))
    make = lambda **kwargs: mitsuba.renderer(sky, "camera.far_clip", resolution=8, spp=1, **kwargs)
    fixed, fresh = make(), make(noise="per_params", seed=3)
    many = jax.jit(jax.vmap(fixed, (None, 0)))(near, keys)
    for image, key in zip(many, keys, strict=True):
        np.testing.assert_array_equal(image, fixed(near, key))
        np.testing.assert_array_equal(image, fresh(near, key))
    assert (many[0] != many[1]).any()
    assert (many[0] != fixed(near)).any()


def test_parameters_that_are_not_finite_never_look_like_a_picture():
    bad = jnp.array([0.0, jnp.nan, 0.0])
    with pytest.raises(BlackBoxError, match=r"not finite(.|\n)*ball.translate"):
        mitsuba.renderer(scene(), "ball.translate", resolution=4, spp=1)(bad)
    render = mitsuba.renderer(scene(), "ball.translate", resolution=4, spp=1, on_nonfinite="nan")
    images = jax.vmap(render)(jnp.stack([bad, jnp.zeros(3)]))
    assert jnp.isnan(images[0]).all()
    assert jnp.isfinite(images[1]).all()


# Variants


def test_renderers_of_several_variants_take_turns():
    other = "scalar_spectral"
    rgb = mitsuba.renderer(scene(), "ball.translate", resolution=8, spp=1)
    spectral = mitsuba.renderer(scene(), "ball.translate", resolution=8, spp=256, variant=other)
    first = rgb(rgb.initial)
    with_spectra = spectral(rgb.initial)
    np.testing.assert_array_equal(rgb(rgb.initial), first)
    smooth = mitsuba.renderer(scene(), "ball.translate", resolution=8, spp=256)(rgb.initial)
    np.testing.assert_allclose(jnp.mean(with_spectra), jnp.mean(smooth), rtol=0.05)


def test_a_loaded_scene_says_its_variant():
    mi.set_variant("scalar_spectral")
    loaded = mi.load_dict(scene(), optimize=False)
    mi.set_variant("scalar_rgb")
    render = mitsuba.renderer(loaded, "ball.scale", resolution=4, spp=1)
    assert render(1.0).shape == (4, 4, 3)
    with pytest.raises(ValueError, match="loaded for variant scalar_spectral"):
        mitsuba.renderer(loaded, "ball.scale", variant="scalar_rgb")


def test_a_variant_that_cannot_run_says_what_to_install(monkeypatch):
    assert mitsuba.available("scalar_rgb")
    assert not mitsuba.available("vulkan_rgb")
    monkeypatch.setattr("drjit.has_backend", lambda backend: False)
    assert not mitsuba.available("cuda_ad_rgb")
    with pytest.raises(RuntimeError, match="install LLVM 17 or newer"):
        mitsuba.renderer(scene(), "ball.scale", variant="llvm_ad_rgb")
    # an old one can be loaded, and aborts the process later
    monkeypatch.setattr("drjit.has_backend", lambda backend: True)
    monkeypatch.setattr("drjit.detail.llvm_version", lambda: (15, 0, 6))
    assert not mitsuba.available("llvm_ad_rgb")
    monkeypatch.setattr("drjit.detail.llvm_version", lambda: (17, 0, 1))
    assert mitsuba.available("llvm_ad_rgb")


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "cuda_ad_rgb"])
def test_vectorised_variants_render_the_same_scene(variant):
    if not mitsuba.available(variant):
        pytest.skip(f"{variant} cannot run here")
    names = [
        *("ball.translate", "board.rotate", "cube.scale", "cube.vertex_texcoords"),
        *("lamp.position", "lamp.intensity.value", "ball.bsdf.reflectance.value"),
    ]
    options = {"axis": (0, 0, 1), "resolution": 8, "spp": 1024}
    scalar = mitsuba.renderer(scene(), names, **options)
    vector = mitsuba.renderer(scene(), names, variant=variant, **options)
    shapes = lambda render: jax.tree.map(jnp.shape, render.initial)
    assert shapes(scalar) == shapes(vector)
    move = {"ball.translate": jnp.array([0.1, 0.2, 0.1]), "cube.scale": 1.2}
    values = {name: move.get(name, value) for name, value in dict(scalar.initial).items()}
    images = scalar(values), vector(values)
    np.testing.assert_allclose(*images, atol=0.05)
    np.testing.assert_allclose(images[0].mean(), images[1].mean(), rtol=0.01)


def test_a_scale_below_zero_is_no_picture_and_changes_none():
    """Mitsuba turns a sphere inside out there, and leaves it so."""
    render = mitsuba.renderer(scene(), "ball.scale", spp=1, on_nonfinite="nan")
    before = render(1.0)
    for scale in (-0.1, 0.0):
        assert np.all(np.isnan(render(scale)))
        np.testing.assert_array_equal(render(1.0), before)


def test_a_parameter_of_the_scene_comes_before_a_motion_of_its_name():
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((8, 16, 3), np.float32)), "scale": 2.0}
    render = mitsuba.renderer(scene(sky=sky), "sky.scale", spp=1)
    assert render.initial == 2.0
    dark, bright = (np.mean(render(scale)) for scale in (0.0, 4.0))
    np.testing.assert_allclose(np.mean(render(2.0)), (dark + bright) / 2, rtol=1e-3)


def test_numbers_of_numpy_are_numbers():
    first: Any = np.int64(0)
    one = mitsuba.renderer(scene(), "ball.translate", spp=1, sensor=first)
    assert one(one.initial).shape == (12, 16, 3)
    seeded = mitsuba.renderer(scene(), "ball.translate", spp=1, seed=first, noise="per_params")
    assert seeded(seeded.initial).shape == (12, 16, 3)
    with pytest.raises(TypeError, match="integer"):
        mitsuba.renderer(scene(), "ball.translate", sensor=0.7)  # pyright: ignore
    with pytest.raises(ValueError, match="alone: give an array"):
        one({"ball.translate": jnp.zeros(3)})


# Misuse


@pytest.mark.parametrize(
    ("params", "options", "message"),
    [
        ("ball.translat", {}, r"'ball.translate'.*It has: .*lamp.position.*cube.scale"),
        ("cube.faces", {}, "no parameter 'cube.faces' made of real numbers"),
        ("lamp.translate", {}, "lamp.position"),
        ([], {}, "at least one"),
        (["ball.scale", "ball.scale"], {}, "each once"),
        (["ball.scale", "ball.to_world"], {}, "cannot be varied together"),
        (["cube.scale", "cube.vertex_positions"], {}, "cannot be varied together"),
        ("ball.rotate", {"axis": (0, 0, 0)}, r"axis=\(x, y, z\)"),
        ("ball.rotate", {"axis": {"ball": (0, 1)}}, r"axis=\(x, y, z\)"),
        ("ball.rotate", {"axis": {"bal": (0, 0, 1)}}, r"axis names \['bal'\]"),
        ("ball.scale", {"noise": "white"}, "per_params"),
        ("ball.scale", {"seed": -1}, "seed"),
        ("ball.scale", {"seed": 2**32}, "seed"),
        ("ball.scale", {"spp": 0}, "spp"),
        ("ball.scale", {"resolution": 0}, "resolution"),
        ("ball.scale", {"sensor": 1}, "1 sensor"),
        ("ball.scale", {"variant": "llvm"}, "variant must be one of"),
    ],
)
def test_bad_arguments(params, options, message):
    with pytest.raises(ValueError, match=message):
        mitsuba.renderer(scene(), params, **options)


def test_bad_scenes():
    bare = {k: v for k, v in scene().items() if k != "integrator"}
    with pytest.raises(ValueError, match='integrator="path"'):
        mitsuba.renderer(bare, "ball.scale")
    with pytest.raises(ValueError, match="pixel_format"):
        mitsuba.renderer(scene(camera=camera(pixel_format="rgba")), "ball.scale")
    sizes = {k: v for k, v in scene().items() if k != "camera"} | {
        "a": camera(),
        "b": camera(width=3),
    }
    with pytest.raises(ValueError, match="choose one resolution"):
        mitsuba.renderer(sizes, "ball.scale", sensor=[0, 1])
    with pytest.raises(TypeError, match="scene must be"):
        mitsuba.renderer(3, "ball.scale")
    with pytest.raises(TypeError, match="scene must be"):
        mitsuba.renderer({"type": "sphere"}, "ball.scale")


def test_wrong_parameters_are_told_when_traced():
    one = mitsuba.renderer(scene(), "ball.translate")
    with pytest.raises(ValueError, match=r"'ball.translate' must .* shape \(3,\), got .* \(2,\)"):
        jax.eval_shape(one, jnp.zeros(2))
    with pytest.raises(ValueError, match="must be real"):
        jax.eval_shape(one, jnp.zeros(3, jnp.complex64))
    many = mitsuba.renderer(scene(), ["ball.translate", "ball.scale"])
    for wrong in (jnp.zeros(3), {"ball.translate": jnp.zeros(3)}):
        with pytest.raises(ValueError, match=r"dict with keys \['ball.translate', 'ball.scale'\]"):
            jax.eval_shape(many, wrong)


# The shadow scene


def test_only_the_shadow_of_the_sphere_is_in_the_picture():
    described = shadow.scene(T())
    described["camera"]["film"] |= {"width": 16, "height": 16}
    loaded = mi.load_dict(described, optimize=False)
    what = mi.load_dict({"type": "aov", "aovs": "shape:shape_index"})
    parameters = mi.traverse(loaded)
    shapes = set()
    for x in np.linspace(-2, 2, 5):  # twice the bounds
        for z in np.linspace(-2, 2, 5):
            centre = np.add(shadow.SPHERE, (x, 0, z))
            parameters["ball.to_world"] = T().translate(centre).scale(shadow.RADIUS)
            parameters.update()
            shapes |= set(np.array(mi.render(loaded, integrator=what, spp=4)).ravel())
    assert len(shapes) == 1  # the floor


def test_the_shadow_is_seen_from_every_start_and_found_only_at_the_reference():
    render, photograph = shadow.make(resolution=16, spp=4)
    lit = photograph.mean(axis=(0, 1)).max()
    see = jax.jit(render)
    loss = lambda picture: np.mean((picture - photograph) ** 2)
    best = loss(np.asarray(see(jnp.asarray(shadow.REFERENCE))))
    for low, high in (shadow.BOUNDS, shadow.START_BOX):
        for x in np.linspace(low[0], high[0], 4):
            for z in np.linspace(low[1], high[1], 4):
                y = np.array([x, z], np.float32)
                picture = np.asarray(see(y))
                assert (picture.max(axis=-1) < 0.2 * lit).sum() >= 4
                assert loss(picture) > 10 * best or np.hypot(*(y - shadow.REFERENCE)) < 0.2


def test_a_crop_window_is_kept():
    """At another resolution and after it, of one loaded scene."""
    film = {"type": "hdrfilm", "width": 32, "height": 32}
    film |= {"crop_width": 8, "crop_height": 16, "crop_offset_x": 12, "crop_offset_y": 8}
    with mitsuba_with("scalar_rgb"):
        scene = mi.load_dict(
            {
                "type": "scene",
                "ball": {"type": "sphere"},
                "sky": {"type": "constant"},
                "camera": {"type": "perspective", "fov": 60, "film": film},
            },
            optimize=False,
        )
    away, options = jnp.array([0.5, 0.5, 5.0]), {"integrator": "direct", "spp": 4}
    render = lambda **more: mitsuba.renderer(scene, "ball.translate", **options, **more)
    own = render()
    seen = own(away)
    assert seen.shape == (16, 8, 3)
    np.testing.assert_allclose(render(resolution=(16, 8))(away), seen, rtol=1e-5)
    finer = render(resolution=(32, 16))(away)
    blocks = finer.reshape(16, 2, 8, 2, 3).mean(axis=(1, 3))
    assert np.mean(np.abs(blocks - seen)) < 0.2 * np.mean(np.abs(seen - np.mean(seen)))
    np.testing.assert_allclose(own(away), seen, rtol=1e-5)
    assert render(resolution=11)(away).shape == (11, 11, 3)
