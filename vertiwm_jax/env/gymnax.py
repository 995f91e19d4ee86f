"""Navigation for code that makes environments by `gymnax.make`; importing this registers it.

    import gymnax, vertiwm_jax.env.gymnax
    env, env_params = gymnax.make("OffRoadNavigation-v0", model="nesam")

To choose maps, tasks or weights yourself, make a `NavigationEnv` and its `make_params`.
"""

from dataclasses import dataclass
from typing import Self

import gymnax
import jax

from vertiwm_jax.env.navigation import NavigationEnv
from vertiwm_jax.env.task import NavigationConfig, TaskParams
from vertiwm_jax.env.tasks import random_tasks
from vertiwm_jax.mechanics.vehicle import hmmwv
from vertiwm_jax.terrain import worlds
from vertiwm_jax.terrain.worlds import WorldConfig
from vertiwm_jax.world_model.choice import ModelName, choose, lean

NAME = "OffRoadNavigation-v0"


@dataclass(frozen=True)
class ProceduralNavigation(NavigationEnv):
    """Goal navigation on procedural worlds, which are its default parameters.

    relief: what the worlds are like. number: of worlds; starts: of random tasks on all of them.
    model: what moves the vehicle, of which `dynamics` is the object. seed: draws worlds and tasks.
    """

    model: ModelName = "builtin"
    relief: WorldConfig = WorldConfig()
    number: int = 8
    starts: int = 256
    seed: int = 0

    @classmethod
    def of(
        cls,
        model: ModelName = "builtin",
        config: NavigationConfig = NavigationConfig(),
        **settings,
    ) -> Self:
        """The environment in a model of `world_model.choice`, with any of the other settings."""
        dynamics, _ = choose(model)
        seen = dynamics if config.embeddings else lean(dynamics)
        return cls(seen, config, model=model, **settings)

    @property
    def default_params(self) -> TaskParams:
        """Drawn and settled anew whenever asked for, in seconds: keep them, and pass them on."""
        world_key, task_key = jax.random.split(jax.random.key(self.seed))
        terrain = worlds.generate(jax.random.split(world_key, self.number), self.relief)
        tasks = random_tasks(task_key, terrain, self.starts, hmmwv())
        return self.make_params(choose(self.model)[1], terrain, tasks)


gymnax.register(NAME, ProceduralNavigation.of)
