"""Writes a scene as a recording for the rerun viewer: the world in 3D, and plots over time."""

import io
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from vertiwm_jax import atomic, figures, geometry
from vertiwm_jax.terrain import picture, query
from vertiwm_jax.viewing.scene import WHEELS, Scene, panels

DRIVEN, PREDICTED = (figures.line(i)[0] for i in (0, 1))
_TIRE, _SPOKE, _CABIN, _OBSTACLE, _GOAL = "#202020", "#D0D0D0", "#A9C9DE", "#4A4A4A", "#000000"


def write(scene: Scene, path: Path) -> None:
    """Writes the recording as a whole, or not at all; raises `WriteError`."""
    with atomic.new_content(path) as unfinished, rr.RecordingStream("vertiwm_jax") as stream:
        stream.set_log_time_enabled(False)
        stream.save(unfinished, _layout(scene))
        _ground(stream, scene)
        _vehicle(stream, scene)
        _plots(stream, scene)
        stream.disconnect()


def _layout(scene: Scene) -> rrb.Blueprint:
    """The world, seen from behind the vehicle, over the map and the plots."""
    start, yaw = scene.state[0, :3], scene.state[0, 5]
    eye = start + np.array([-12 * np.cos(yaw), -12 * np.sin(yaw), 7.0])
    controls = rrb.EyeControls3D(position=eye, look_target=start, tracking_entity="world/vehicle")
    name, (x, y) = scene.title, scene.terrain.offset(scene.world)
    if scene.terrain.middles:
        name += f"; positions are counted from ({x:.10g}, {y:.10g})"
    world = rrb.Spatial3DView(origin="world", name=name, eye_controls=controls)
    over_time = [
        rrb.TimeSeriesView(origin=_entity("plots", title), name=title) for title in panels(scene)
    ]
    below = rrb.Grid(rrb.Spatial2DView(origin="map", name="map"), *over_time, grid_columns=3)
    return rrb.Blueprint(
        rrb.Vertical(world, below, row_shares=[3, 2]),
        rrb.TimePanel(timeline="time", state="collapsed", play_state="playing"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _ground(stream: rr.RecordingStream, scene: Scene) -> None:
    terrain = scene.terrain
    _still(stream, "world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    elevation = np.asarray(terrain.elevation[scene.world])
    rows, columns = elevation.shape
    west, east, south, north = picture.extent(terrain)
    u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    x, y = west + u * (east - west), north - v * (north - south)
    # The corners of each cell: north-west, north-east, south-west, south-east.
    nw = np.arange(rows * columns).reshape(rows, columns)[:-1, :-1].ravel()
    ne, sw, se = nw + 1, nw + columns, nw + columns + 1
    mesh = rr.Mesh3D(
        vertex_positions=np.stack([x, y, elevation], axis=-1).reshape(-1, 3),
        triangle_indices=np.stack([nw, sw, ne, ne, sw, se], axis=-1).reshape(-1, 3),
        vertex_texcoords=np.stack([u, v], axis=-1).reshape(-1, 2),
        albedo_texture=(255 * picture.shaded(terrain, scene.world)).round().astype(np.uint8),
    )
    _still(stream, "world/terrain", mesh)
    overview = io.BytesIO()
    terrain.subset(np.array([scene.world])).plot([scene.title]).savefig(overview, format="png")
    legend = rr.EncodedImage(contents=overview.getvalue(), media_type="image/png")
    _still(stream, "map", legend)
    boxes = np.asarray(terrain.obstacles[scene.world])
    boxes = boxes[boxes[:, 4] > 0]
    if len(boxes):
        base = np.asarray(query.height(terrain, jnp.asarray(boxes[:, :2])))
        centers = np.column_stack([boxes[:, :2], base + boxes[:, 4] / 2])
        _still(stream, "world/obstacles", _boxes(centers, boxes[:, 2:], _OBSTACLE))
    if scene.goal is not None:
        place, radius, color = [scene.goal], scene.goal_radius, _rgb(_GOAL)
        _still(stream, "world/goal", rr.Points3D(place, radii=0.6, colors=color))
        ring = rr.Cylinders3D(centers=place, radii=radius, lengths=2.0, colors=color)
        _still(stream, "world/goal/ring", ring)


def _vehicle(stream: rr.RecordingStream, scene: Scene) -> None:
    """The vehicle, its wheels, the path driven, and the predicted paths."""
    vehicle, state = scene.vehicle, scene.state
    _moving(stream, "world/vehicle", scene, state[:, :3], state[:, 3:6])
    _still(stream, "world/path", _lines([state[:, :3]], DRIVEN))
    heights = np.asarray(vehicle.hull)[:, 2]
    low, high = heights.min(), heights.max()
    waist = (low + high) / 2
    length, width = float(vehicle.length), float(vehicle.track - np.max(vehicle.wheel_width))
    # The cabin is at the rear, so that this can be told from the front.
    hull = _boxes([[0, 0, (low + waist) / 2]], [[length, width, waist - low]], DRIVEN)
    cabin = [[-0.175 * length, 0, (waist + high) / 2]], [[0.65 * length, width, high - waist]]
    _still(stream, "world/vehicle/body", hull)
    _still(stream, "world/vehicle/cabin", _boxes(*cabin, _CABIN))
    radii, widths = (np.broadcast_to(x, 4) for x in (vehicle.wheel_radius, vehicle.wheel_width))
    for i, name in enumerate(WHEELS):
        radius, width = float(radii[i]), float(widths[i])
        tire = rr.Cylinders3D(
            lengths=width,
            radii=radius,
            rotation_axis_angles=rr.RotationAxisAngle(axis=[1, 0, 0], radians=np.pi / 2),
            colors=_rgb(_TIRE),
            fill_mode="solid",
        )
        spoke = _boxes([[0, 0, 0]], [[1.5 * radius, 1.04 * width, 0.2 * radius]], _SPOKE)
        entity = _entity("world", "vehicle", "wheels", name)
        turned, steered = scene.turned[:, i], scene.steering[:, i]
        rpy = np.stack([np.zeros_like(turned), turned, steered], axis=1)
        place = np.broadcast_to([*vehicle.wheel_position[i], 0.0], rpy.shape)
        _moving(stream, entity, scene, place, rpy)
        _still(stream, entity, tire)
        _still(stream, f"{entity}/spoke", spoke)
    if scene.prediction:
        strips = scene.prediction.state[..., :3]
        _still(stream, "world/predictions", _lines(strips, PREDICTED))


def _plots(stream: rr.RecordingStream, scene: Scene) -> None:
    for title, lines in panels(scene).items():
        for i, (name, values) in enumerate(lines.items()):
            entity, known = _entity("plots", title, name), np.isfinite(values)
            style = rr.SeriesLines(colors=_rgb(figures.line(i)[0]), names=name, widths=1.5)
            _still(stream, entity, style)
            columns = rr.Scalars.columns(scalars=values[known])
            stream.send_columns(entity, _times(scene, known), columns, strict=True)


def _still(stream: rr.RecordingStream, entity: str, shown: Any) -> None:
    stream.log(entity, shown, static=True, strict=True)


def _moving(
    stream: rr.RecordingStream, entity: str, scene: Scene, place: np.ndarray, rpy: np.ndarray
) -> None:
    """Poses `[T + 1, 3]` m and rad of an entity, in the frame of the one that it is part of."""
    wxyz = geometry.rotation_from_rpy(jnp.asarray(rpy, jnp.float32)).wxyz
    poses = rr.Transform3D.columns(translation=place, quaternion=np.roll(wxyz, -1, axis=-1))
    stream.send_columns(entity, _times(scene), poses, strict=True)


def _boxes(centers: Any, sizes: Any, color: str) -> rr.Boxes3D:
    return rr.Boxes3D(centers=centers, sizes=sizes, colors=_rgb(color), fill_mode="solid")


def _lines(strips: Any, color: str) -> rr.LineStrips3D:
    return rr.LineStrips3D(strips, colors=_rgb(color), radii=0.07)


def _times(scene: Scene, shown: np.ndarray | slice = slice(None)) -> list[rr.TimeColumn]:
    """Both time lines of some of the states: steps, and seconds."""
    return [
        rr.TimeColumn("step", sequence=np.arange(scene.steps + 1)[shown]),
        rr.TimeColumn("time", duration=scene.seconds[shown]),
    ]


def _entity(*parts: str) -> str:
    return rr.new_entity_path(list(parts))


def _rgb(color: str) -> list[int]:
    """A color such as #0072B2 as three numbers up to 255."""
    return list(bytes.fromhex(color[1:]))
