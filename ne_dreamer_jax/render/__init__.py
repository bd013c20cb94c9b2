"""Pixels of MuJoCo scenes in pure JAX: no OpenGL, no host callback, vmap and jit as usual.

``scene = build(mj_model, camera_id)`` once per task on the host, then ``draw(scene, data)`` for one state.
"""

import os

# mujoco looks for an OpenGL library when it is imported, unless told that none is wanted.
os.environ.setdefault("MUJOCO_GL", "disable")

from ne_dreamer_jax.render.build import build
from ne_dreamer_jax.render.picture import draw
from ne_dreamer_jax.render.record import record, recorded
from ne_dreamer_jax.render.scene import Scene
from ne_dreamer_jax.render.solids import Overrides

__all__ = ["Overrides", "Scene", "build", "draw", "record", "recorded"]
