"""Our parameters under the names and in the layout of the authors' released code."""

from __future__ import annotations

from typing import Any

import numpy as np

from ne_dreamer_jax.agents.dreamer.agent import AgentConfig
from ne_dreamer_jax.objectives import DreamerPro, NextEmbedding, Reconstruction, SameStep

Tree = Any
Named = dict[str, np.ndarray]


def to_theirs(config: AgentConfig, side: int, tree: Tree) -> Named:
    """A tree like the agent's parameters (parameters, or gradients) as name -> array of the authors' code.

    Linear layers are transposed, convolutions are [out, in, height, width]. Embeddings of pictures are flattened
    channel by channel there, pixel by pixel here.
    """
    tree = _arrays(tree)
    order = _order(config, side)
    named = _encoder(config, tree["encoder"])
    named |= _rssm(config, tree["rssm"], order)
    for ours, theirs in (("reward", "reward"), ("continue", "cont"), ("actor", "actor"), ("critic", "value")):
        named |= _head(theirs, theirs, tree[ours])
    return named | _objective(config, tree["objective"], order)


def _arrays(tree: Tree) -> Tree:
    if isinstance(tree, dict):
        return {name: _arrays(value) for name, value in tree.items()}
    return np.asarray(tree)


def _order(config: AgentConfig, side: int) -> np.ndarray:
    """Their embedding is ours at these places."""
    stages = config.encoder.multipliers
    small, channels = side // 2 ** len(stages), config.encoder.depth * stages[-1]
    of_picture = np.arange(small * small * channels).reshape(small, small, channels).transpose(2, 0, 1).ravel()
    return np.concatenate([of_picture, of_picture.size + np.arange(config.encoder.units)])


def _linear(name: str, layer: Tree) -> Named:
    named = {f"{name}.weight": layer["kernel"].T}
    return named | ({f"{name}.bias": layer["bias"]} if "bias" in layer else {})


def _norm(name: str, layer: Tree) -> Named:
    layer = layer.get("norm", layer)
    named = {f"{name}.weight": layer["scale"]}
    return named | ({f"{name}.bias": layer["bias"]} if "bias" in layer else {})


def _block(linear: str, norm: str, block: Tree) -> Named:
    return _linear(linear, block["linear"]) | _norm(norm, block["norm"])


def _mlp(prefix: str, name: str, mlp: Tree) -> Named:
    named: Named = {}
    for i in range(len(mlp)):
        named |= _block(f"{prefix}.{name}_linear{i}", f"{prefix}.{name}_norm{i}", mlp[f"block{i}"])
    return named


def _head(prefix: str, name: str, head: Tree) -> Named:
    return _mlp(f"{prefix}.mlp.layers", name, head["mlp"]) | _linear(f"{prefix}.last", head["out"])


def _conv(name: str, kernel: np.ndarray, bias: np.ndarray) -> Named:
    return {f"{name}.weight": kernel.transpose(3, 2, 0, 1), f"{name}.bias": bias}


def _encoder(config: AgentConfig, tree: Tree) -> Named:
    named = _mlp("encoder.encoders.1.layers", "mlp_encoder", tree["mlp"])
    for i in range(len(config.encoder.multipliers)):
        stage = f"encoder.encoders.0.layers.{4 * i}"
        named |= _conv(stage, tree[f"stage{i}_kernel"], tree[f"stage{i}_bias"])
        named[f"encoder.encoders.0.layers.{4 * i + 2}.weight"] = tree[f"stage{i}_scale"]
    return named


def _rssm(config: AgentConfig, tree: Tree, order: np.ndarray) -> Named:
    deter, blocks = config.rssm.deter, config.rssm.blocks
    inner = "dynamics._deter_net"
    named: Named = {}
    for i, name in enumerate(("deter_in", "stoch_in", "action_in")):
        named |= _block(f"{inner}._dyn_in{i}.0", f"{inner}._dyn_in{i}.1", tree[name])
    inputs = tree["input_kernel"].reshape(-1, blocks, deter // blocks).transpose(1, 0, 2)
    named[f"{inner}._dyn_hid.dyn_hid_0.weight"] = np.concatenate([tree["state_kernel"], inputs], axis=1)
    named[f"{inner}._dyn_hid.dyn_hid_0.bias"] = tree["hidden_bias"]
    named |= _norm(f"{inner}._dyn_hid.norm_0", tree["hidden_norm"])
    named[f"{inner}._dyn_gru.weight"] = tree["gate_kernel"]
    named[f"{inner}._dyn_gru.bias"] = tree["gate_bias"].ravel()
    kernel = tree["posterior_kernel"]
    kernel = np.concatenate([kernel[:deter], kernel[deter:][order]])
    named |= _linear("dynamics._obs_net.obs_net_0", {"kernel": kernel, "bias": tree["posterior_bias"]})
    named |= _norm("dynamics._obs_net.obs_net_n_0", tree["posterior_norm"])
    named |= _linear("dynamics._obs_net.obs_net_logit", tree["posterior_out"])
    for i in range(config.rssm.prior_layers):
        block = tree["prior_mlp"][f"block{i}"]
        named |= _block(f"dynamics._img_net.img_net_{i}", f"dynamics._img_net.img_net_n_{i}", block)
    return named | _linear("dynamics._img_net.img_net_logit", tree["prior_out"])


def _out(layer: Tree, order: np.ndarray) -> Tree:
    """A layer that gives embeddings, in their order."""
    return {name: value[..., order] for name, value in layer.items()}


def _in(layer: Tree, order: np.ndarray) -> Tree:
    """A layer that takes embeddings, in their order."""
    return {**layer, "kernel": layer["kernel"][order]}


def _objective(config: AgentConfig, tree: Tree, order: np.ndarray) -> Named:
    objective = config.objective
    if isinstance(objective, NextEmbedding):
        return _predictor(objective, tree, order)
    if isinstance(objective, SameStep):
        return _linear("projector.w", _out(tree["projector"], order))
    if isinstance(objective, DreamerPro):
        of_embedding = _linear("obs_proj", _in(tree["embedding"], order))
        return of_embedding | _linear("feat_proj", tree["feature"]) | {"prototypes": tree["prototypes"]}
    if isinstance(objective, Reconstruction):
        return _decoder(config, tree)
    return {}


def _predictor(objective: NextEmbedding, tree: Tree, order: np.ndarray) -> Named:
    name = "ne_transformer"
    projects = objective.predictor.projector
    named = _linear("projector.w", _out(tree["projector"], order)) if projects else {}
    named |= _linear(f"{name}.f_embed", _in(tree["state_in"], order) if projects else tree["state_in"])
    named |= _linear(f"{name}.a_embed.0", tree["action_in"]) | _norm(f"{name}.a_embed.1", tree["action_norm"])
    named[f"{name}.pos_embed"] = tree["positions"][None]
    for i in range(objective.predictor.layers):
        layer, ours = f"{name}.transformer.layers.{i}", tree[f"layer{i}"]
        attention = _linear("", ours["qkv"])
        named[f"{layer}.self_attn.in_proj_weight"] = attention[".weight"]
        named[f"{layer}.self_attn.in_proj_bias"] = attention[".bias"]
        named |= _linear(f"{layer}.self_attn.out_proj", ours["out"])
        named |= _linear(f"{layer}.linear1", ours["up"]) | _linear(f"{layer}.linear2", ours["down"])
        named |= _norm(f"{layer}.norm1", ours["attention_norm"]) | _norm(f"{layer}.norm2", ours["feedforward_norm"])
    head = f"{name}.heads_next.0" if objective.shift else f"{name}.head_same"
    named |= _norm(f"{head}.0", tree["out_norm"]) | _linear(f"{head}.1", tree["hidden"])
    return named | _linear(f"{head}.3", _out(tree["out"], order))


def _decoder(config: AgentConfig, tree: Tree) -> Named:
    stages = len(config.encoder.multipliers)
    named = {"decoder._cnn.sp0.weight": tree["deter_kernel"], "decoder._cnn.sp0.bias": tree["deter_bias"].ravel()}
    named |= _block("decoder._cnn.sp1.0", "decoder._cnn.sp1.1", tree["stoch_in"])
    named |= _linear("decoder._cnn.sp2", tree["stoch_out"]) | _norm("decoder._cnn.sp_norm.0", tree["norm"])
    for place, i in enumerate(reversed(range(stages))):
        stage = f"decoder._cnn.layers.{4 * place + 1}"
        named |= _conv(stage, tree[f"stage{i}_kernel"], tree[f"stage{i}_bias"])
        if i:
            named |= _norm(f"decoder._cnn.layers.{4 * place + 2}", tree[f"stage{i}_norm"])
    return (
        named
        | _mlp("decoder._mlp.mlp.layers", "mlp_decoder", tree["mlp"])
        | _linear("decoder._mlp.last", tree["vectors"])
    )
