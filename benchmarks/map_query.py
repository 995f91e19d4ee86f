"""Claim: patch queries of 20 environments take under 2 ms on two cores.

Also measured: the ground under wheels, which a simulator asks for in every sub-step, and drawing
a procedural world.
"""

import jax
import jax.numpy as jnp

from benchmarks._harness import measure, parser, report
from vertiwm_jax.terrain import patches, query, worlds
from vertiwm_jax.terrain.worlds import WorldConfig

VEHICLES = 20
POINTS = 4096 * 4  # the wheels of 4,096 vehicles


def main() -> None:
    as_json = parser(__doc__).parse_args().json
    config = WorldConfig(rocks=20, trees=2)
    world_keys = jax.random.split(jax.random.key(0), VEHICLES)
    drawn = measure(lambda keys: worlds.generate(keys, config), world_keys, seconds=0.5)
    terrain = worlds.generate(world_keys, config)
    xy_key, yaw_key, point_key = jax.random.split(jax.random.key(1), 3)
    position = jax.random.uniform(xy_key, (VEHICLES, 3), minval=-60.0, maxval=60.0)
    yaw = jax.random.uniform(yaw_key, (VEHICLES,), minval=-jnp.pi, maxval=jnp.pi)
    points = jax.random.uniform(point_key, (POINTS // 4, 4, 2), minval=-60.0, maxval=60.0)
    world = jnp.arange(VEHICLES)
    worlds_of_points = jnp.arange(POINTS // 4) % VEHICLES

    look = jax.jit(jax.vmap(lambda m, w, p, a: patches.query(m.select(w), p, a), (None, 0, 0, 0)))
    surface = jax.jit(jax.vmap(lambda m, w, p: query.surface(m.select(w), p), (None, 0, 0)))

    seen = measure(look, terrain, world, position, yaw)
    touched = measure(surface, terrain, worlds_of_points, points)
    report(
        "map query",
        {
            f"patches of {VEHICLES} vehicles": seen,
            f"surface at {POINTS} points": {
                **touched,
                "points_per_s": POINTS / touched["median_s"],
            },
            f"{VEHICLES} procedural worlds": drawn,
        },
        as_json,
    )


if __name__ == "__main__":
    main()
