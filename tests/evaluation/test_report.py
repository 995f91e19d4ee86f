import csv
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vertiwm_jax.env.controllers import REFERENCE
from vertiwm_jax.env.episodes import NavigationResult
from vertiwm_jax.env.termination import TerminationReason as Reason
from vertiwm_jax.evaluation import report
from vertiwm_jax.terrain import map as terrain_map
from vertiwm_jax.terrain.map import TerrainMap

SUITES = ["hard", "easy", "hard"]
WORLD = [0, 0, 1, 1, 2, 2]


def result(reached: list[int]) -> NavigationResult:
    """Two episodes on each of three worlds, of 10, 20, ... steps; `reached` are 0 or 1."""
    ending = jnp.where(jnp.asarray(reached) == 1, int(Reason.GOAL), int(Reason.STUCK))
    steps = 10 * (1 + jnp.arange(6))
    zeros, points = jnp.zeros(6), jnp.zeros((6, 61, 3))
    return NavigationResult(
        ending=ending,
        steps=steps,
        abs_roll=zeros,
        abs_pitch=zeros,
        driven=steps * 0.5,
        final_distance=zeros,
        world=jnp.asarray(WORLD),
        goal=jnp.zeros((6, 3)),
        position=points,
        rpy=points,
    )


@pytest.fixture(scope="module")
def groups():
    results = {
        "learned": result([1, 1, 1, 0, 1, 0]),
        REFERENCE: result([0, 1, 1, 1, 0, 0]),
        "random": result([0, 0, 0, 0, 0, 0]),
    }
    return report.by_suite(results, SUITES)


def test_episodes_go_to_the_suite_of_their_world(groups):
    assert list(groups) == ["hard", "easy"]
    for name, worlds in (("hard", [0, 0, 2, 2]), ("easy", [1, 1])):
        for episodes in groups[name].values():
            assert episodes.world.tolist() == worlds
            assert {len(leaf) for leaf in jax.tree.leaves(episodes)} == {len(worlds)}
    assert groups["hard"]["learned"].steps.tolist() == [10, 20, 50, 60]


def test_summary_is_json_and_counts_rescues(groups):
    summary = json.loads(json.dumps(report.summary(groups), allow_nan=False))
    hard, easy = summary["hard"], summary["easy"]
    assert (hard["learned"]["successes"], hard[REFERENCE]["successes"]) == (3, 1)
    # Of the tasks 0, 4 and 5 that the reference fails, the learned policy solves 0 and 4.
    assert hard["learned"]["solved_of_reference_failures"] == 2
    assert easy["learned"]["solved_of_reference_failures"] == 0
    assert easy[REFERENCE]["solved_of_reference_failures"] == 0
    assert hard["learned"]["seconds"] == pytest.approx(np.mean([1, 2, 5]), rel=1e-5)
    assert hard["random"]["seconds"] is None
    assert hard["random"]["endings"] == {"stuck": 4}


def test_markdown_has_a_table_for_each_suite(groups):
    text = report.markdown(groups)
    assert text.index("**hard**") < text.index("**easy**")
    assert "Solved of the 3 tasks that straight to goal fails: learned 2, random 0" in text
    assert "Solved of the 0 tasks that straight to goal fails: learned 0, random 0" in text
    rows = [line for line in text.splitlines() if line.startswith("| learned ")]
    assert [row.split("|")[2].strip() for row in rows] == ["3/4", "1/2"]


def test_the_reference_alone_is_compared_with_nothing(groups):
    text = report.markdown({"easy": {REFERENCE: groups["easy"][REFERENCE]}})
    assert f"| {REFERENCE} " in text and "Solved" not in text


def test_everything_is_written(groups, tmp_path):
    level = TerrainMap.from_array(np.zeros((65, 65)), np.zeros((8, 8), int))
    terrain = terrain_map.stack([level] * 3)
    report.write(tmp_path / "new", groups, terrain, 8.0)
    left = {path.name for path in (tmp_path / "new").iterdir()}
    pictures = {"trajectories_hard.png", "trajectories_easy.png"}
    assert left == {"summary.md", "summary.json", "episodes.csv", *pictures}
    with (tmp_path / "new" / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * 6
    first = rows[0]
    assert (first["suite"], first["policy"], first["world"]) == ("hard", "learned", "0")
    assert (first["ending"], first["seconds"], first["driven_m"]) == ("goal", "1.0", "5.0")


def test_far_worlds_are_told_as_in_their_files(groups, tmp_path):
    places = [(0.0, 0.0), (512345.0, 5234567.0), (312345.0, 4234567.0)]
    corners = np.array(places) + [-32, 32]
    classes = np.zeros((8, 8), int)
    levels = [TerrainMap.from_array(np.zeros((65, 65)), classes, origin=xy) for xy in corners]
    terrain = terrain_map.stack(levels)
    report.write(tmp_path, groups, terrain, 8.0)
    with (tmp_path / "episodes.csv").open() as file:
        for row in csv.DictReader(file):
            assert (float(row["goal_x"]), float(row["goal_y"])) == places[int(row["world"])]
    figure = terrain.plot()
    figure.draw_without_rendering()
    for axes, (x, y) in zip(figure.axes, places, strict=False):
        for axis, middle in ((axes.xaxis, x), (axes.yaxis, y)):
            told = {
                label.get_text().replace("\N{MINUS SIGN}", "-") for label in axis.get_ticklabels()
            }
            assert f"{middle:.10g}" in told
