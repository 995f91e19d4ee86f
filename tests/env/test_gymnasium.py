import gymnasium
import jax
import numpy as np
import pytest
from env.worlds import bicycle_env, ground, hills, task
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import vertiwm_jax.gym
from vertiwm_jax.env.gymnasium import NavigationGymEnv, NavigationVectorEnv
from vertiwm_jax.env.suites import circle_tasks
from vertiwm_jax.env.task import NavigationConfig


@pytest.fixture(scope="module")
def short():
    """Episodes of 3 steps."""
    terrain = ground(hills(), [[9.0, 3.0, 4.0, 6.0, 2.0]])
    config = NavigationConfig(horizon_seconds=0.3)
    return bicycle_env(terrain, circle_tasks(terrain), config)


@pytest.mark.filterwarnings("error", "ignore:.*not having a spec")
@pytest.mark.integration
def test_single_passes_gymnasium_s_own_check(short):
    check_env(NavigationGymEnv(*short, render_mode="rgb_array"))


def test_single_ends_by_truncation_and_shows_the_world(short):
    env = NavigationGymEnv(*short, render_mode="rgb_array")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(env.action_space.sample())
    env.reset(seed=3)
    ends = [env.step(np.array([1.0, 0.0], np.float32))[2:] for _ in range(3)]
    assert [end[:2] for end in ends] == [(False, False), (False, False), (False, True)]
    assert ends[-1][2]["ending"] == "timed_out"
    picture = env.render()
    assert picture.shape == (512, 512, 3) and picture.dtype == np.uint8
    red = (picture == np.round(255 * np.array([0.8, 0.05, 0.05]))).all(-1)
    # 4.6 m x 2.1 m, less the white nose, at 16 pixels a square metre.
    assert red.sum() == pytest.approx(0.75 * 4.6 * 2.1 * 16, rel=0.15)


def test_single_knows_its_render_modes(short):
    with pytest.raises(ValueError, match="render_mode: expected None or"):
        NavigationGymEnv(*short, render_mode="human")


def test_the_vehicle_is_drawn_where_it_is():
    env = NavigationGymEnv(*bicycle_env(ground(), task((40, 20), (0, 0))), render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render().astype(int)
    rows, columns = np.nonzero(picture[..., 0] - picture[..., 1] > 150)
    assert columns.mean() / 4 - 64 == pytest.approx(40, abs=1)
    assert 64 - rows.mean() / 4 == pytest.approx(20, abs=1)


def test_vector_resets_in_the_step_that_ends(short):
    env = NavigationVectorEnv(*short, num_envs=4)
    assert env.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    first, info = env.reset(seed=5)
    again, _ = env.reset(seed=5)
    np.testing.assert_array_equal(first, again)
    assert first in env.observation_space and info == {}
    assert AHEAD in env.action_space
    for _ in range(2):
        _, _, terminated, truncated, info = env.step(AHEAD)
        assert not (terminated | truncated).any() and "final_obs" not in info
        assert info["_distance"].all()
    observation, reward, terminated, truncated, info = env.step(AHEAD)
    assert not terminated.any() and truncated.all() and reward.shape == (4,)
    assert observation in env.observation_space
    assert info["_final_obs"].all() and not info["_ending"].any()
    assert (info["final_info"]["ending"] == "timed_out").all()
    starts = np.asarray(short[1].start_observation)
    for now, final in zip(observation, info["final_obs"], strict=True):
        assert (now == starts).all(-1).any() and not (final == starts).all(-1).any()


AHEAD = np.tile(np.array([1.0, 0.0], np.float32), (4, 1))


def test_vector_resets_in_the_step_after(short):
    env = NavigationVectorEnv(*short, num_envs=4, autoreset_mode=AutoresetMode.NEXT_STEP)
    env.reset(seed=5)
    steps = [env.step(AHEAD) for _ in range(7)]
    assert [step[3].tolist() for step in steps] == [[i % 4 == 2] * 4 for i in range(7)]
    last, begun = steps[2][0], steps[3]
    starts = np.asarray(short[1].start_observation)
    assert not (last[:, None] == starts).all(-1).any()
    assert (begun[0][:, None] == starts).all(-1).any(-1).all()
    assert not begun[1].any() and not begun[2].any() and not begun[4]["_ending"].any()
    assert "final_obs" not in steps[2][4]


def test_vector_resets_only_where_it_is_told(short):
    env = NavigationVectorEnv(*short, num_envs=4, autoreset_mode="Disabled")
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset all vehicles first"):
        env.reset(options={"reset_mask": np.array([True, False, False, False])})
    env.reset(seed=5)
    env.step(AHEAD)
    mask = np.array([False, True, False, False])
    env.reset(options={"reset_mask": mask})
    env.step(AHEAD)
    ended, _, _, truncated, _ = env.step(AHEAD)
    np.testing.assert_array_equal(truncated, ~mask)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"reset vehicles \[0, 2, 3\] first"):
        env.step(AHEAD)
    begun, _ = env.reset(options={"reset_mask": truncated})
    np.testing.assert_array_equal(begun[1], ended[1])
    assert env.step(AHEAD)[3].tolist() == mask.tolist()


def test_seeds_are_of_vehicles(short):
    env = NavigationVectorEnv(*short, num_envs=4)
    first, _ = env.reset(seed=[7, 8, 9, 10])
    np.testing.assert_array_equal(env.reset(seed=7)[0], first)
    np.testing.assert_array_equal(env.reset(seed=[10, 9, 8, 7])[0], first[::-1])
    drawn = [env.reset(seed=[7, None, 9, None])[0] for _ in range(5)]
    assert all((seen[::2] == first[::2]).all() for seen in drawn)
    assert len(np.unique([seen[1] for seen in drawn], axis=0)) > 1


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"seed": [1, 2]}, "seed: expected 4 of them, found 2"),
        ({"options": {"start": 3}}, "options: expected none of these, found start"),
        ({"options": {"reset_mask": np.ones(3, bool)}}, r"reset_mask: expected \[4\] bool"),
        ({"options": {"reset_mask": np.zeros(4, bool)}}, "at least one of them true"),
        ({"options": {"reset_mask": np.arange(4)}}, r"bool, .* found \[0, 1, 2, 3\]"),
    ],
)
def test_what_a_reset_cannot_do_is_refused(short, given, told):
    with pytest.raises(ValueError, match=told):
        NavigationVectorEnv(*short, num_envs=4).reset(**given)


def test_single_has_no_options(short):
    with pytest.raises(ValueError, match="options: expected none of these, found start"):
        NavigationGymEnv(*short).reset(options={"start": 3})


def test_vector_agrees_with_single(short):
    env, params = short
    vector = NavigationVectorEnv(env, params, num_envs=4)
    vector.reset(seed=0)
    states, step = vector._seen[1], jax.jit(env.step_env)
    action = np.array([[0.3, -0.6], [1.0, 0.2], [-1.0, 0.0], [0.0, 1.0]], np.float32)
    observation, reward, *_ = vector.step(action)
    for i in range(4):
        state = jax.tree.map(lambda x, i=i: x[i], states)
        expected = step(jax.random.key(0), state, action[i], params)
        np.testing.assert_allclose(observation[i], expected[0], atol=1e-5)
        np.testing.assert_allclose(reward[i], expected[2], rtol=1e-4)


@pytest.mark.filterwarnings("error")
@pytest.mark.integration
def test_the_task_is_made_by_its_name():
    settings = {"terrain": ground(hills()), "model": "bicycle", "pairs": 2}
    single = gymnasium.make(vertiwm_jax.gym.NAME, **settings)
    observation, _ = single.reset(seed=0)
    assert observation in single.observation_space
    assert single.step(single.action_space.sample())[4]["ending"] == "running"
    many = gymnasium.make_vec(vertiwm_jax.gym.NAME, num_envs=3, **settings)
    assert many.reset(seed=0)[0].shape == (3, *single.observation_space.shape)
    assert many.step(many.action_space.sample())[4]["ending"].tolist() == ["running"] * 3
