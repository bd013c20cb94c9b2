"""Pictures equal MuJoCo's own, which are stored (benchmarks/mujoco_pictures.py made them)."""

import dataclasses
import os
import pathlib
import subprocess
import sys
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from benchmarks import mujoco_pictures
from benchmarks.render import similarity
from ne_dreamer_jax import render
from tests.marks import slow_but

STORED = pathlib.Path(__file__).parent / "references.npz"
# Mean absolute error (of 255) and structural similarity on the stored states, with a margin of a tenth over what they
# are. A domain that moves beyond them looks different.
LIMITS = {
    "acrobot": (1.0, 0.985),
    "ball_in_cup": (1.0, 0.985),
    "cartpole": (1.0, 0.985),
    "cheetah": (1.0, 0.985),
    "finger": (1.0, 0.985),
    "hopper": (1.0, 0.985),
    "pendulum": (1.0, 0.985),
    "quadruped": (1.0, 0.985),
    "reacher": (1.0, 0.985),
    "walker": (1.0, 0.985),
}
QUICK = ("cartpole", "walker")  # one with a camera that stands and one with a camera that moves
POSE = ("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "xpos", "subtree_com")


@pytest.mark.parametrize("domain", slow_but(mujoco_pictures.TASKS, *QUICK))
def test_pictures_equal_mujocos(domain, quick_compilation):
    stored = mujoco_pictures.load(STORED, domain)
    draw = jax.jit(mujoco_pictures.drawer(render.build(stored.model, stored.camera)))
    drawn = np.asarray(draw(stored.data, stored.sizes))
    assert drawn.dtype == np.uint8
    assert drawn.shape == stored.images.shape
    error = np.abs(drawn.astype(float) - stored.images).mean((1, 2, 3))
    alike = [similarity(*pair) for pair in zip(drawn, stored.images, strict=True)]
    most, least = LIMITS[domain]
    assert error.mean() <= most, error
    assert np.mean(alike) >= least, alike


# A scene with each kind of object, small, for what needs no comparison with MuJoCo's pictures.
SCENE = """
<mujoco>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1=".4 .6 .8" rgb2="0 0 0" width="32" height="32"/>
    <texture name="grid" type="2d" builtin="checker" rgb1=".1 .2 .3" rgb2=".2 .3 .4" width="16" height="16"/>
    <texture name="photo" type="2d" builtin="gradient" rgb1="0 0 0" rgb2="1 1 1" width="16" height="16"/>
    <material name="grid" texture="grid" texrepeat="1 1" texuniform="true" reflectance=".2"/>
    <material name="photo" texture="photo"/>
    <material name="glow" emission="1"/>
    <material name="dull" shininess=".1"/>
  </asset>
  <worldbody>
    <light name="lamp" pos="0 0 3" {light}/>
    <camera name="front" pos="0 -3 1" xyaxes="1 0 0 0 .3 1" {camera}/>
    <geom name="floor" type="plane" size="4 4 .2" {floor}/>
    <geom name="wall" type="plane" size="1 1 .1" pos="0 2 1" zaxis="0 -1 0" rgba=".6 .3 .3 1"/>
    <body name="mover" pos="0 0 .5">
      <freejoint/>
      <geom name="ball" type="sphere" size=".2" rgba=".7 .5 .3 1"/>
      <geom name="rod" type="capsule" size=".1 .2" pos=".5 0 0" rgba=".7 .5 .3 1"/>
      <geom name="can" type="cylinder" size=".1 .2" pos="-.5 0 0" rgba=".7 .5 .3 1"/>
      <geom name="egg" type="ellipsoid" size=".1 .2 .1" pos="0 0 .5" rgba=".7 .5 .3 1"/>
      <geom name="block" type="box" size=".1 .1 .1" pos=".5 0 .5" rgba=".7 .5 .3 1"/>
      <site name="mark" size=".1" pos="-.5 0 .5" rgba="1 0 0 1"/>
      {extra}
    </body>
    <body name="other" pos="0 -1 1"><freejoint/><geom name="bead" type="sphere" size=".05"/>
      <site name="hook" pos="0 0 .1"/></body>
    {world}
  </worldbody>
  {tendon}
</mujoco>
"""


def compile_model(**parts):
    parts = {name: parts.get(name, "") for name in ("light", "camera", "extra", "tendon", "world")} | {
        "floor": parts.get("floor", 'material="grid"')
    }
    return mujoco.MjModel.from_xml_string(SCENE.format(**parts))


def pose(model, qpos=None):
    """What draw needs of an mjx.Data, as C MuJoCo computes it."""
    data = mujoco.MjData(model)
    if qpos is not None:
        data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return types.SimpleNamespace(**{name: jnp.asarray(getattr(data, name), jnp.float32) for name in POSE})


@pytest.fixture(scope="module")
def small(quick_compilation):
    """A model of all kinds of objects, its scene, and a function that draws a pose of it at 48 x 64 pixels."""
    string = '<spatial limited="true" range="0 2" width=".03"><site site="mark"/><site site="hook"/></spatial>'
    model = compile_model(tendon=f"<tendon>{string}</tendon>")
    scene = render.build(model, 0, height=48, width=64)
    colors = {  # as drawn: a material's where there is one
        f"{kind}_rgba": np.where(
            (getattr(model, f"{kind}_matid") >= 0)[:, None],
            model.mat_rgba[getattr(model, f"{kind}_matid")],
            getattr(model, f"{kind}_rgba"),
        )
        for kind in ("geom", "site")
    }
    usual = {"geom_size": model.geom_size, "site_size": model.site_size, **colors}
    usual = {name: jnp.asarray(value, jnp.float32) for name, value in usual.items()}

    @jax.jit
    def draw(data, overrides):
        return render.draw(scene, types.SimpleNamespace(**data), render.Overrides(**overrides))

    return model, scene, lambda data, **overrides: np.asarray(draw(vars(data), usual | overrides))


def test_a_batch_is_drawn_as_its_states_are(small):
    model, scene, draw = small
    rng = np.random.default_rng(0)
    poses = [pose(model, model.qpos0 + 0.2 * rng.normal(size=model.nq)) for _ in range(3)]
    batch = {name: jnp.stack([getattr(p, name) for p in poses]) for name in POSE}
    together = jax.jit(jax.vmap(lambda data: render.draw(scene, types.SimpleNamespace(**data))))(batch)
    assert together.shape == (3, 48, 64, 3)
    for drawn, one in zip(np.asarray(together), poses, strict=True):
        # Compiled apart, a sample on an edge may fall to its other side.
        assert (drawn != draw(one)).any(-1).mean() < 0.01
        assert np.abs(drawn.astype(int) - draw(one)).mean() < 0.1


def test_every_object_is_seen_and_an_alpha_of_zero_hides_it(small):
    model, _, draw = small
    data = pose(model)
    everything = draw(data)
    for kind, count in (("geom", model.ngeom), ("site", model.nsite)):
        rgba = np.array(getattr(model, f"{kind}_rgba"))
        for i in range(count):
            name = getattr(model, kind)(i).name
            if name in ("floor", "wall", "hook"):  # planes can't be hidden; the hook is inside the string's end
                continue
            hidden = rgba.copy()
            hidden[i, 3] = 0
            without = draw(data, **{f"{kind}_rgba": jnp.asarray(hidden, jnp.float32)})
            assert (without != everything).any(-1).sum() > 2, name


def test_sizes_and_places_change_the_picture(small):
    model, _, draw = small
    data = pose(model)
    everything = draw(data)
    site = model.site("mark").id
    larger = draw(data, site_size=jnp.asarray(model.site_size, jnp.float32).at[site, 0].set(0.3))
    moved = draw(types.SimpleNamespace(**vars(data) | {"site_xpos": data.site_xpos.at[site, 0].add(-0.2)}))

    def red(image):
        return ((image[..., 0] > 100) & (image[..., 1] < 60)).sum()

    assert red(larger) > 2 * red(everything) > 0
    assert red(moved) > 0
    assert (moved != everything).any()


def test_the_string_is_taut_and_red_when_its_ends_are_far_apart(small):
    model, _, draw = small
    qpos = model.qpos0.copy()
    qpos[7:10] = (1.4, -1.0, 1.2)

    def reddish(image):  # of the string; the mark's own colour is the same in both
        return ((image[..., 0].astype(int) - image[..., 1] > 60) & (image[..., 1] < 90)).sum()

    assert reddish(draw(pose(model, qpos))) > reddish(draw(pose(model)))


def test_objects_cast_shadows_and_are_reflected(small):
    model, scene, draw = small
    data = pose(model)
    floor_rows = slice(36, 48)  # below all objects

    def without(light="", **changes):
        other = render.build(compile_model(light=light), 0, 48, 64)
        other = dataclasses.replace(other, **changes)
        return np.asarray(jax.jit(lambda d: render.draw(other, types.SimpleNamespace(**d)))(vars(data)))

    usual = draw(data)
    assert (without(light='castshadow="false"')[floor_rows].mean(-1) > usual[floor_rows].mean(-1)).any()
    views = {"center_rays": scene.center_rays[:1], "sample_rays": scene.sample_rays[:1]}
    assert (without(**views)[floor_rows].mean(-1) < usual[floor_rows].mean(-1)).any()


REFUSED = {
    "mode='targetbody'": ({"camera": "mode='targetbody' target='mover'"}, "camera 'front'", "turns"),
    "orthographic": ({"camera": "projection='orthographic'"}, "camera 'front'", "orthographic"),
    "sensor size": ({"camera": "sensorsize='1 1' resolution='8 8'"}, "camera 'front'", "fovy"),
    "coloured light": ({"light": "diffuse='1 0 0'"}, "light 'lamp'", "coloured"),
    "turning light": ({"light": "mode='targetbody' target='mover'"}, "light 'lamp'", "turns"),
    "point light": ({"light": "type='point'"}, "light 'lamp'", "POINT"),
    "translucent": ({"extra": "<geom name='ghost' size='.1' rgba='1 1 1 .5'/>"}, "geom 'ghost'", "translucent"),
    "translucent site": ({"extra": "<site name='ghost' rgba='1 1 1 .5'/>"}, "site 'ghost'", "translucent"),
    "glowing": ({"extra": "<geom name='lamp' size='.1' material='glow'/>"}, "geom 'lamp'", "emits"),
    "textured": ({"extra": "<geom name='globe' size='.1' material='grid'/>"}, "geom 'globe'", "textured"),
    "two floors": (
        {"world": "<geom name='table' type='plane' size='1 1 1' material='grid'/>"},
        "geom 'table'",
        "only one plane",
    ),
    "two materials": ({"extra": "<geom name='clay' size='.1' material='dull'/>"}, "geom 'clay'", "shininess"),
    "photo": ({"floor": 'material="photo"'}, "texture 'photo'", "two colours"),
    "stiff tendon": (
        {"tendon": "<tendon><spatial name='rope'><site site='mark'/><site site='hook'/></spatial></tendon>"},
        "tendon 'rope'",
        "strings",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cant_be_drawn_is_refused_by_name(case):
    parts, name, reason = REFUSED[case]
    with pytest.raises(ValueError, match=reason) as caught:
        render.build(compile_model(**parts), 0)
    assert name in str(caught.value)


@pytest.mark.parametrize(
    ("asset", "geom"),
    [
        ('<mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>', '<geom name="odd" type="mesh" mesh="m"/>'),
        ('<hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/>', '<geom name="odd" type="hfield" hfield="h"/>'),
    ],
)
def test_shapes_without_an_intersection_are_refused(asset, geom):
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><asset>{asset}</asset><worldbody><camera name='c'/>{geom}</worldbody></mujoco>"
    )
    with pytest.raises(ValueError, match=r"geom 'odd' can't be drawn: its type is mjGEOM_(MESH|HFIELD)"):
        render.build(model, 0)
    # Out of sight it does no harm.
    model.geom_group[:] = 3
    assert render.build(model, 0).groups == ()


def test_a_camera_that_does_not_exist_is_refused_with_those_that_do():
    with pytest.raises(ValueError, match=r"an id from 0 to 0, got 3; the model has \['front'\]"):
        render.build(compile_model(), 3)


def test_a_moving_camera_may_see_a_scene_without_floor_sky_or_light():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body name='b'><freejoint/><geom name='g' size='.5'/>"
        "<camera name='c' mode='trackcom' pos='0 -2 0' xyaxes='1 0 0 0 0 1'/></body></worldbody></mujoco>"
    )
    image = np.asarray(render.draw(render.build(model, 0, 16, 16), pose(model)))
    assert image[8, 8].min() > 100
    assert (image[0, 0] == 0).all()


def test_drawing_loads_no_opengl():
    code = (
        "import sys; from ne_dreamer_jax import render; import mujoco\n"
        "words = ('opengl', 'glfw', 'egl', 'osmesa')\n"
        "assert not [m for m in sys.modules if any(word in m.lower() for word in words)]"
    )
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300, env=environment)
