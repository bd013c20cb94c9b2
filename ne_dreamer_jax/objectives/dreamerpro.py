"""DreamerPro's objective: predict prototype assignments of randomly shifted views, given by a slow teacher."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp

from ne_dreamer_jax.losses import assignment_loss, sinkhorn
from ne_dreamer_jax.nets.blocks import Linear
from ne_dreamer_jax.nets.microbatches import in_microbatches
from ne_dreamer_jax.nets.pixels import centred
from ne_dreamer_jax.objectives.augment import random_shift
from ne_dreamer_jax.objectives.base import Model, Objective
from ne_dreamer_jax.settings import ranges
from ne_dreamer_jax.settings.ranges import CountOrNone, Positive, Range, Share, Width
from ne_dreamer_jax.types import Array, Batch, Metrics, Params, Rollout


@dataclass(frozen=True)
class DreamerPro:
    """Settings of the prototypical objective; the defaults are its authors'.

    Two views of every sequence are encoded and unrolled. Assignments of a step are Sinkhorn's, from the teacher's
    embedding of a view at that step. They are predicted, always for the same step,

    - ``swav``: from the embedding of the other view,
    - ``temporal``: from the latent state of the same view,

    and ``norm`` holds the lengths of the projections, which the predictions don't depend on, near one. As in the code
    that the paper compares methods with, everything else (KL, reward, continuation, behaviour) sees the batch as it is;
    DreamerPro's own authors train all of it on the shifted views. Prototypes count by their direction alone.

    Source: DreamerPro: Reconstruction-Free Model-Based Reinforcement Learning with Prototypical Representations (Deng
    et al., 2022).
    """

    prototypes: Width = 2500
    dimension: Width = 32
    """Size of prototypes and projections."""
    temperature: Positive = 0.1
    """Of the predictions."""
    epsilon: Positive = 0.05
    """Of the assignments; see `losses.swav.sinkhorn`."""
    iterations: Annotated[int, Range(1, 10_000)] = 3
    """Of Sinkhorn's algorithm."""
    teacher_rate: Share = 0.05
    """Share of the encoder and the projection that moves into the teacher at each update."""
    frozen_updates: CountOrNone = 10_000
    """Updates at the start in which the prototypes stay as they are."""
    max_shift: Annotated[float, Range(0.0, 1e6)] = 3.0
    """Pixels by which a view may be shifted in each direction; the same across time."""
    whole_shifts: bool = False
    """Whether views are shifted by whole pixels only (the released code) or by any distance (DreamerPro)."""
    projection_init: Literal["fan_in", "uniform"] = "fan_in"
    """How both projections start: as every other layer, biases at zero; or weights and biases uniform within
    1/sqrt(fan in) (the released code, which leaves them as PyTorch makes them): 1.73 times smaller."""
    warm_up: CountOrNone = 1
    """Steps at the start of a sequence that count for neither ``swav`` nor ``temporal``."""

    def __post_init__(self) -> None:
        ranges.check(self)

    @property
    def losses(self) -> Mapping[str, float]:
        """Names and weights of the losses."""
        return {"swav": 1.0, "temporal": 1.0, "norm": 1.0}

    def build(self, model: Model) -> Objective:
        """The objective's functions.

        Raises ValueError where there is no image to shift, or where the warm-up leaves no step.
        """
        nets = model.nets
        images = [name for name, spec in nets.spec.observation.items() if len(spec.shape) == 3]
        if not images:
            raise ValueError(
                f"DreamerPro shifts images: expected one among the observations, got {sorted(nets.spec.observation)}. "
                "Choose another method, or observe pixels."
            )
        if not 0 <= self.warm_up < model.length:
            raise ValueError(
                f"objective.warm_up: expected 0 or more and less than agent.batch_length {model.length}, got "
                f"{self.warm_up}."
            )
        linear = Linear(self.dimension, dtype=nets.dtype)
        shift = functools.partial(random_shift, largest=self.max_shift, whole=self.whole_shifts)

        def init(key: Array) -> Params:
            of_embedding, of_feature, of_prototypes = jax.random.split(key, 3)
            return {
                "embedding": self._projection(of_embedding, nets.embedding),
                "feature": self._projection(of_feature, nets.feature),
                "prototypes": _unit(jax.random.normal(of_prototypes, (self.prototypes, self.dimension)))[0],
            }

        def init_target(params: Params) -> Params:
            return jax.tree.map(jnp.copy, _taught(params)) | {"update": jnp.zeros((), jnp.int32)}

        def after_update(params: Params, target: Params, update: Array) -> Params:
            rate = self.teacher_rate
            slow = {name: target[name] for name in _taught(params)}
            return jax.tree.map(lambda s, p: s + rate * (p - s), slow, _taught(params)) | {"update": update}

        def loss(params: Params, target: Params, key: Array, rollout: Rollout) -> tuple[dict[str, Array], Metrics]:
            shift_key, unroll_key = jax.random.split(key)
            batch = _two_views(rollout.batch)
            shifted = {name: shift(shift_key, centred(batch.obs[name])) for name in images}
            batch = batch._replace(obs={**batch.obs, **shifted})
            views = model.unroll(params, unroll_key, batch)

            own = params["objective"]
            frozen = target["update"] < self.frozen_updates
            prototypes, _ = _unit(jnp.where(frozen, jax.lax.stop_gradient(own["prototypes"]), own["prototypes"]))

            def scores(projection: Params, x: Array) -> tuple[Array, Array]:
                """Cosines ``[2, N, K]`` of the two views with the prototypes, and the projections' lengths."""
                projected: Any = linear.apply({"params": projection}, x)
                unit, length = _unit(projected.astype(jnp.float32))
                unit = unit[:, self.warm_up :].reshape(2, -1, self.dimension)
                return jnp.matmul(unit, prototypes.T, precision=jax.lax.Precision.HIGHEST), length

            teach = lambda obs: nets.apply("encoder", target, obs)
            teacher = in_microbatches(teach, model.microbatches)(batch.obs)
            given, _ = scores(target["projection"], jax.lax.stop_gradient(teacher))
            assignment = jax.vmap(lambda view: sinkhorn(view, self.epsilon, self.iterations))(given)
            of_embedding, embedding_length = scores(own["embedding"], views.embedding)
            of_feature, feature_length = scores(own["feature"], views.feature)
            predict = jax.vmap(lambda scores, assignment: assignment_loss(scores, assignment, self.temperature))
            losses = {
                "swav": jnp.mean(predict(of_embedding, assignment[::-1])),
                "temporal": jnp.mean(predict(of_feature, assignment)),
                "norm": jnp.mean(jnp.square(embedding_length - 1.0)) + jnp.mean(jnp.square(feature_length - 1.0)),
            }
            used = jnp.mean(assignment, axis=(0, 1))
            entropy = -jnp.sum(used * jnp.log(jnp.maximum(used, 1e-20)))
            return losses, {"prototypes/used_entropy": jax.lax.stop_gradient(entropy)}

        return Objective(init, init_target, loss, after_update)

    def _projection(self, key: Array, inputs: int) -> Params:
        """Fresh parameters of a linear map ``[..., inputs]`` to ``[..., dimension]``."""
        linear = Linear(self.dimension)
        if self.projection_init == "uniform":
            uniform = _uniform_within(inputs**-0.5)
            linear = Linear(self.dimension, kernel_init=uniform, bias_init=uniform)
        return linear.init(key, jnp.zeros((1, inputs)))["params"]


def _uniform_within(bound: float) -> Callable[..., Array]:
    """An initialiser between ``-bound`` and ``bound``."""
    return lambda key, shape, dtype: jax.random.uniform(key, shape, dtype, -bound, bound)


def _taught(params: Params) -> Params:
    """What the teacher is a slow copy of."""
    return {"encoder": params["encoder"], "projection": params["objective"]["embedding"]}


def _two_views(batch: Batch) -> Batch:
    """``[2 * B, ...]``: the batch twice."""
    return jax.tree.map(lambda x: jnp.concatenate([x, x]), batch)


def _unit(x: Array) -> tuple[Array, Array]:
    """``x [..., n]`` scaled to length one, and its lengths ``[...]``."""
    length = jnp.sqrt(jnp.sum(jnp.square(x), axis=-1, keepdims=True) + 1e-12)
    return x / length, length[..., 0]
