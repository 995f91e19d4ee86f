import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from vertiwm_jax.state import Command, VehicleState


def test_the_state_vector_has_the_papers_order_and_is_undone():
    vector = jnp.arange(24.0).reshape(2, 12)
    state = VehicleState.from_vector(vector)
    np.testing.assert_array_equal(state.position[0], [0, 1, 2])
    np.testing.assert_array_equal(state.rpy[0], [3, 4, 5])
    np.testing.assert_array_equal(state.velocity[0], [6, 7, 8])
    np.testing.assert_array_equal(state.angular_velocity[0], [9, 10, 11])
    np.testing.assert_array_equal(state.vector, vector)


def test_the_command_vector_is_speed_then_steering():
    command = Command.from_vector(jnp.array([[3.0, -0.1], [4.0, 0.2]]))
    np.testing.assert_array_equal(command.speed, [3.0, 4.0])
    np.testing.assert_allclose(command.steering, [-0.1, 0.2])
    np.testing.assert_allclose(command.vector, [[3.0, -0.1], [4.0, 0.2]])


def test_the_pose_takes_the_body_to_the_world():
    rng = np.random.default_rng(0)
    vector = rng.uniform(-1, 1, size=(4, 12)).astype(np.float32)
    poses = VehicleState.from_vector(jnp.asarray(vector)).pose.as_matrix()
    for matrix, row in zip(poses, np.float64(vector), strict=True):
        rotation = Rotation.from_euler("ZYX", row[5:2:-1]).as_matrix()
        np.testing.assert_allclose(matrix[:3, :3], rotation, atol=1e-6)
        np.testing.assert_allclose(matrix[:3, 3], row[:3], atol=1e-7)


def test_states_and_commands_flow_through_jit_and_vmap():
    states = VehicleState.from_vector(jnp.ones((3, 12)))
    commands = Command.from_vector(jnp.full((3, 2), 0.5))

    @jax.jit
    @jax.vmap
    def hold(state: VehicleState, command: Command) -> VehicleState:
        return VehicleState.from_vector(state.vector * command.speed)

    np.testing.assert_array_equal(hold(states, commands).vector, jnp.full((3, 12), 0.5))
