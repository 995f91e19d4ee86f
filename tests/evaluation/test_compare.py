import json

import jax.numpy as jnp
import pytest

from vertiwm_jax.env.episodes import NavigationResult
from vertiwm_jax.env.termination import TerminationReason as Reason
from vertiwm_jax.evaluation import compare


def result(reached: int) -> NavigationResult:
    """Four episodes of 10 s, of which some reach the goal."""
    zeros, points = jnp.zeros(4), jnp.zeros((4, 2, 3))
    ending = jnp.where(jnp.arange(4) < reached, int(Reason.GOAL), int(Reason.STUCK))
    return NavigationResult(
        ending=ending,
        steps=jnp.full(4, 100),
        abs_roll=zeros,
        abs_pitch=zeros,
        driven=zeros,
        final_distance=zeros,
        world=zeros,
        goal=points[:, 0],
        position=points,
        rpy=points,
    )


def test_costs_are_of_all_sessions_of_a_training(tmp_path):
    # Two iterations, then hours until it was resumed.
    lines = [
        {"step": 1, "wall_time": 10.0, "timesteps": 600, "timesteps_per_second": 100.0},
        {"step": 2, "wall_time": 16.0, "timesteps": 1200, "timesteps_per_second": 50.0},
        {"step": 3, "wall_time": 9999.0, "timesteps": 1800, "timesteps_per_second": 200.0},
    ]
    (tmp_path / "metrics.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    seconds, steps = compare.cost(tmp_path)
    assert seconds == pytest.approx(6 + 12 + 3) and steps == 1800


def test_every_simulator_has_a_table_of_all_policies():
    costs = {"ppo in vertiwm": (120.0, 360_000)}
    easy = {"ppo in vertiwm": result(3), "straight to goal": result(0)}
    hard = {"ppo in vertiwm": result(1), "straight to goal": result(2)}
    tested = {"builtin": {"easy": easy, "hard": hard}, "vertiwm": {"easy": hard}}
    first, second = compare.markdown(costs, tested).split("**vertiwm**")
    learned, straight = (
        [cell.strip() for cell in line.split("|")[1:-1]] for line in first.strip().splitlines()[-2:]
    )
    level = "0.0 / 0.0 deg"
    solved = [f"3/4, 10.0 s, {level}", f"1/4, 10.0 s, {level}"]
    assert learned == ["ppo in vertiwm", "2.0", "3,000", *solved]
    assert straight == ["straight to goal", "", "", f"0/4, {level}", f"2/4, 10.0 s, {level}"]
    assert "hard" not in second and f"| 1/4, 10.0 s, {level} |" in second
