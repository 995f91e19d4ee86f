import jax
import jax.numpy as jnp

from benchmarks import operations


def test_operations_of_a_program_are_found_and_timed():
    def function(x: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, 3, lambda _, y: jnp.sin(y) @ x, x)

    x = jnp.eye(64)
    compiled = jax.jit(function).lower(x).compile()
    named = operations.named(compiled.as_text())
    spent = operations.recorded(compiled, (x,))
    timed = {name for name in named if name in spent and named[name][0] == "f32[64,64]"}
    assert any("dot" in named[name][1] for name in timed)
    assert all(spent[name][0] > 0 for name in timed)
    # Three rounds of the loop in every call, and the loop itself is not among what is in it.
    assert {spent[name][1] for name in timed} >= {3 * operations._CALLS}
    assert not any(name.startswith("while") for name in named)
