"""What does not fit is refused by the names and shapes that the caller passed."""

import jax
import jax.numpy as jnp
import pytest

from ne_dreamer_jax import losses

A, B, L = jnp.zeros((3, 4)), jnp.zeros((3, 5)), jnp.zeros((3, 4, 7))
BINS = jnp.linspace(-1.0, 1.0, 7)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: losses.reinforce_loss(A, A, B, A), r"got log_prob \(3, 4\), advantage \(3, 4\), entropy \(3, 5\)"),
        (lambda: losses.dynamics_loss(A, A, B), r"got normalized_return \(3, 4\), entropy \(3, 4\), weight \(3, 5\)"),
        (
            lambda: losses.critic_loss(L, A, B, A, BINS),
            r"expected slow_value of shape \(3, 4\), that of logits \(3, 4, 7\)",
        ),
        (lambda: losses.critic_loss(L, A, A, B, BINS), r"expected weight of shape \(3, 4\).*got \(3, 5\)"),
        (lambda: losses.categorical_kl(A, B), r"got p_logits \(3, 4\), q_logits \(3, 5\)"),
        (lambda: losses.balanced_kl(L, L[:, :2]), r"got posterior_logits \(3, 4, 7\), prior_logits \(3, 2, 7\)"),
        (lambda: losses.lambda_returns(A, A, B), r"got reward \(3, 4\), value \(3, 4\), discount \(3, 5\)"),
        (lambda: losses.twohot_loss(A, A, BINS), r"expected logits of shape \(3, 4, 7\), for a target \(3, 4\)"),
        (lambda: losses.barlow_twins(A, B), r"\(3, 4\).*\(3, 5\)"),
        (lambda: losses.cosine_alignment(A, B), r"\(3, 4\).*\(3, 5\)"),
    ],
)
def test_shapes_that_do_not_agree_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.strict
@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float16, jnp.float32])
def test_losses_are_float32_whatever_they_are_given(dtype):
    a, logits, one = A.astype(dtype), L.astype(dtype), jnp.ones((), dtype)
    flag = jnp.zeros(A.shape, bool)
    for name, found in {
        "reinforce": losses.reinforce_loss(a, a, a, a, one),
        "dynamics": losses.dynamics_loss(a, a, a, one),
        "critic": losses.critic_loss(logits, a, a, a, BINS.astype(dtype)),
        "returns": losses.lambda_returns(a, a, a, 0.9, flag),
        "percentiles": losses.update_percentiles(one, one, a),
        "scale": losses.return_scale(one, one),
        "kl": losses.balanced_kl(logits, logits),
        "assignment": losses.assignment_loss(a, a),
        "sinkhorn": losses.sinkhorn(a),
        "twohot": losses.twohot_loss(logits, a, BINS.astype(dtype)),
    }.items():
        assert {x.dtype for x in jax.tree.leaves(found)} == {jnp.dtype(jnp.float32)}, name
