from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from rerun.chunk import RrdReader
from viewing.scenes import STEPS, bare, scene

from vertiwm_jax import geometry
from vertiwm_jax.viewing import recording
from vertiwm_jax.viewing.scene import panels


def read(path):
    """Columns by entity and name, as lists of rows, and the names of its time lines."""
    found, times = {}, set()
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        times |= set(chunk.timeline_names)
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            found.setdefault(chunk.entity_path.strip("/"), {})[name] = column.to_pylist()
    return found, times


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "scene.rrd"
    recording.write(scene(), path)
    return read(path)


def test_the_vehicle_goes_where_it_was_driven(found):
    entities, times = found
    assert times == {"step", "time"}
    vehicle, state = entities["world/vehicle"], scene().state
    assert vehicle["step"] == list(range(STEPS + 1))
    seconds = [time.total_seconds() for time in vehicle["time"]]
    np.testing.assert_allclose(seconds, 0.1 * np.arange(STEPS + 1))
    np.testing.assert_allclose(np.squeeze(vehicle["Transform3D:translation"]), state[:, :3])
    x, y, z, w = np.squeeze(vehicle["Transform3D:quaternion"]).T
    expected = geometry.rotation_from_rpy(jnp.asarray(state[:, 3:6])).wxyz
    np.testing.assert_allclose(np.stack([w, x, y, z], axis=1), expected, atol=1e-6)


def test_all_of_the_scene_is_there(found):
    entities, full = found[0], scene()
    assert set(entities) >= {
        "world/terrain", "world/obstacles", "world/goal", "world/goal/ring", "world/path",
        "world/predictions", "world/vehicle/body", "world/vehicle/cabin", "map",
        "world/vehicle/wheels/front\\ left", "world/vehicle/wheels/rear\\ right/spoke",
    }  # fmt: skip
    mesh = entities["world/terrain"]
    vertices = np.array(mesh["Mesh3D:vertex_positions"][0])
    triangles = np.array(mesh["Mesh3D:triangle_indices"][0])
    assert vertices.shape == (65 * 65, 3) and triangles.shape == (2 * 64 * 64, 3)
    assert vertices[0].tolist() == [-32, 32, full.terrain.elevation[0, 0, 0]]
    edges = vertices[triangles]
    up = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])[:, 2]
    np.testing.assert_allclose(up, 1.0)  # each half a cell of 1 m, its outside above
    (box,) = entities["world/obstacles"]["Boxes3D:half_sizes"][0]
    assert box == [1, 1.5, 0.5]
    # The rear right wheel has turned half a radian in each step, and does not steer.
    turned = np.squeeze(entities["world/vehicle/wheels/rear\\ right"]["Transform3D:quaternion"])
    expected = np.sin(0.25 * np.arange(1, 4))
    np.testing.assert_allclose(turned[:3], [[0, y, 0, np.sqrt(1 - y * y)] for y in expected])
    drawn = {entity.split("/", 1)[1] for entity in entities if entity.startswith("plots/")}
    assert len(drawn) == sum(map(len, panels(full).values()))
    speed = entities["plots/speed\\ \\[m\\/s\\]/commanded"]["Scalars:scalars"]
    np.testing.assert_allclose(np.squeeze(speed)[:-1], full.command[:, 0])


def test_a_far_scene_tells_where_it_is(tmp_path):
    far = replace(bare(), terrain=replace(bare().terrain, middles=((512345.5, 5234567.0),)))
    recording.write(far, tmp_path / "far.rrd")
    assert b"positions are counted from (512345.5, 5234567)" in (tmp_path / "far.rrd").read_bytes()


def test_a_drive_alone(tmp_path):
    recording.write(bare(), tmp_path / "bare.rrd")
    entities, _ = read(tmp_path / "bare.rrd")
    assert "world/vehicle" in entities
    assert not {"world/goal", "world/predictions"} & set(entities)


def test_a_recording_that_fails_leaves_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "scene.rrd"
    path.write_bytes(b"old")

    def fail(stream, scene):
        raise RuntimeError("in the middle")

    monkeypatch.setattr(recording, "_plots", fail)
    with pytest.raises(RuntimeError, match="in the middle"):
        recording.write(bare(), path)
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
