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
    timed = named.keys() & spent.keys()
    assert any("dot" in named[name][1] for name in timed)
    assert all(spent[name][0] > 0 for name in timed)
    # Three rounds of the loop in every call, and the loop itself is not among what is in it.
    assert 3 * operations._CALLS in {spent[name][1] for name in timed}
    loops = {name for name in spent if name.startswith("while")}
    assert loops and not loops & timed
