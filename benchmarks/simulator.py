"""Steps of 0.1 s that the built-in simulator takes in a second, by batch, on mixed ground."""

import jax
import jax.numpy as jnp

from benchmarks._harness import measure, parser, report
from vertiwm_jax.dynamics import rollout
from vertiwm_jax.mechanics.kinematic import rest_on_ground
from vertiwm_jax.mechanics.simulator import Simulator, chrono_like
from vertiwm_jax.mechanics.vehicle import hmmwv
from vertiwm_jax.state import Command, VehicleState
from vertiwm_jax.terrain import worlds
from vertiwm_jax.terrain.worlds import WorldConfig

BATCHES = (1, 20, 256, 1024)
STEPS = 50


def main() -> None:
    as_json = parser(__doc__).parse_args().json
    simulator, params = Simulator(), chrono_like(hmmwv())
    terrain = worlds.generate(jax.random.split(jax.random.key(0), 1), WorldConfig())
    vehicle = params.vehicle

    def drive(xy: jax.Array, yaw: jax.Array, commands: Command) -> jax.Array:
        position, rpy = rest_on_ground(
            terrain, xy, yaw, vehicle.wheelbase, vehicle.track, vehicle.wheel_radius
        )
        state = VehicleState(position, rpy, jnp.zeros(3), jnp.zeros(3))
        history = simulator.init(params, terrain, state)
        return rollout(simulator, params, terrain, history, state, commands).position[-1]

    results = {}
    for batch in BATCHES:
        keys = jax.random.split(jax.random.key(1), 4)
        commands = Command(
            speed=jax.random.uniform(keys[0], (batch, STEPS), maxval=4.0),
            steering=jax.random.uniform(keys[1], (batch, STEPS), minval=-0.3, maxval=0.3),
        )
        xy = jax.random.uniform(keys[2], (batch, 2), minval=-40.0, maxval=40.0)
        yaw = jax.random.uniform(keys[3], (batch,), minval=-jnp.pi, maxval=jnp.pi)
        figures = measure(jax.jit(jax.vmap(drive)), xy, yaw, commands, repeats=5)
        rate = batch * STEPS / figures["median_s"]
        results[f"batch {batch}"] = {"steps_per_s": rate, **figures}
    report("simulator", results, as_json)


if __name__ == "__main__":
    main()
