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
from vertiwm_jax.models.registry import ModelName, load_encoders, load_model
from vertiwm_jax.terrain import worlds
from vertiwm_jax.terrain.worlds import WorldConfig

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
        """The environment in a model of `load_model`, with any of the other settings."""
        dynamics, _ = load_model(model, embeddings=config.embeddings)
        return cls(dynamics, config, model=model, **settings)

    @property
    def default_params(self) -> TaskParams:
        """Drawn and settled anew whenever asked for, in seconds: keep them, and pass them on."""
        world_key, task_key = jax.random.split(jax.random.key(self.seed))
        terrain = worlds.generate(jax.random.split(world_key, self.number), self.relief)
        tasks = random_tasks(task_key, terrain, self.starts, hmmwv())
        encoders = load_encoders() if self.config.embeddings else None
        return self.make_params(load_model(self.model)[1], terrain, tasks, encoders=encoders)


gymnax.register(NAME, ProceduralNavigation.of)
