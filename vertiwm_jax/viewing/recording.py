"""Writes a scene as a recording for the rerun viewer: the world in 3D, and plots over time."""

from functools import partial
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
_TYRE, _SPOKE, _CABIN, _OBSTACLE, _GOAL = "#202020", "#D0D0D0", "#A9C9DE", "#4A4A4A", "#000000"


def write(scene: Scene, path: Path) -> None:
    """Writes the recording as a whole, or not at all; raises `WriteError`."""
    with atomic.new_content(path) as unfinished, rr.RecordingStream("vertiwm_jax") as stream:
        stream.set_log_time_enabled(False)
        stream.save(unfinished, _layout(scene))
        _ground(stream, scene)
        _vehicle(stream, scene)
        _paths(stream, scene)
        _plots(stream, scene)
        stream.disconnect()


def _layout(scene: Scene) -> rrb.Blueprint:
    """The world, seen from behind the vehicle, over the plots."""
    yaw = scene.state[0, 5]
    eye = scene.state[0, :3] + np.array([-12 * np.cos(yaw), -12 * np.sin(yaw), 7.0])
    world = rrb.Spatial3DView(
        origin="world",
        name=scene.title,
        eye_controls=rrb.EyeControls3D(
            position=eye, look_target=scene.state[0, :3], tracking_entity="world/vehicle"
        ),
    )
    over_time = [
        rrb.TimeSeriesView(origin=_entity("plots", title), name=title) for title in panels(scene)
    ]
    return rrb.Blueprint(
        rrb.Vertical(world, rrb.Grid(*over_time, grid_columns=3), row_shares=[3, 2]),
        rrb.TimePanel(timeline="time", state="collapsed", play_state="playing"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _ground(stream: rr.RecordingStream, scene: Scene) -> None:
    log = partial(stream.log, static=True, strict=True)
    terrain = scene.terrain
    elevation = np.asarray(terrain.elevation[scene.world])
    rows, columns = elevation.shape
    west, east, south, north = picture.extent(terrain)
    u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    x, y = west + u * (east - west), north - v * (north - south)
    # The corners of each cell: north-west, north-east, south-west, south-east.
    number = np.arange(rows * columns).reshape(rows, columns)
    lower, upper = slice(1, None), slice(None, -1)
    nw, ne, sw, se = (number[i, j].ravel() for i in (upper, lower) for j in (upper, lower))
    image = (255 * picture.shaded(terrain, scene.world)).round().astype(np.uint8)
    log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    log(
        "world/terrain",
        rr.Mesh3D(
            vertex_positions=np.stack([x, y, elevation], axis=-1).reshape(-1, 3),
            triangle_indices=np.stack([nw, sw, ne, ne, sw, se], axis=-1).reshape(-1, 3),
            vertex_texcoords=np.stack([u, v], axis=-1).reshape(-1, 2),
            albedo_texture=image,
        ),
    )
    boxes = np.asarray(terrain.obstacles[scene.world])
    boxes = boxes[boxes[:, 4] > 0]
    if len(boxes):
        base = np.asarray(query.height(terrain, jnp.asarray(boxes[:, :2])))
        centres = np.column_stack([boxes[:, :2], base + boxes[:, 4] / 2])
        log(
            "world/obstacles",
            rr.Boxes3D(
                centers=centres, sizes=boxes[:, 2:], colors=_rgb(_OBSTACLE), fill_mode="solid"
            ),
        )
    if scene.goal is not None:
        around = np.linspace(0, 2 * np.pi, 73)
        ring = scene.goal[:2] + scene.goal_radius * np.stack([np.cos(around), np.sin(around)], 1)
        heights = np.asarray(query.height(terrain, jnp.asarray(ring, jnp.float32)))
        log(
            "world/goal/ring",
            rr.LineStrips3D(
                [np.column_stack([ring, heights + 0.2])], colors=_rgb(_GOAL), radii=0.08
            ),
        )
        log("world/goal", rr.Points3D([scene.goal], radii=0.6, colors=_rgb(_GOAL)))


def _vehicle(stream: rr.RecordingStream, scene: Scene) -> None:
    poses = rr.Transform3D.columns(
        translation=scene.state[:, :3], quaternion=_quaternion(scene.state[:, 3:6])
    )
    stream.send_columns("world/vehicle", _times(scene), poses, strict=True)
    body = _body(scene, colors=[_rgb(DRIVEN), _rgb(_CABIN)], fill_mode="solid")
    stream.log("world/vehicle/body", body, static=True, strict=True)
    for i, name in enumerate(WHEELS):
        _wheel(stream, scene, i, _entity("world", "vehicle", "wheels", name))
    if scene.prediction:
        states = scene.prediction.along(scene.prediction.states, scene.steps)
        shown = np.flatnonzero(np.isfinite(states[:, 0]))
        poses = rr.Transform3D.columns(
            translation=states[shown, :3], quaternion=_quaternion(states[shown, 3:6])
        )
        stream.send_columns("world/predicted", _times(scene, shown), poses, strict=True)
        # Not before the first prediction.
        stream.set_time("step", sequence=int(shown[0]))
        stream.set_time("time", duration=float(scene.seconds[shown[0]]))
        outline = _body(scene, colors=_rgb(PREDICTED), radii=0.03)
        stream.log("world/predicted/body", outline, strict=True)


def _body(scene: Scene, **style: Any) -> rr.Boxes3D:
    """Two boxes: bonnet and cabin, so that the front can be told from the rear."""
    vehicle, heights = scene.vehicle, np.asarray(scene.vehicle.hull)[:, 2]
    low, high = heights.min(), heights.max()
    waist = (low + high) / 2
    length, width = float(vehicle.length), float(vehicle.track - vehicle.wheel_width)
    return rr.Boxes3D(
        mins=[[-length / 2, -width / 2, low], [-length / 2, -width / 2, waist]],
        sizes=[[length, width, waist - low], [0.65 * length, width, high - waist]],
        **style,
    )


def _wheel(stream: rr.RecordingStream, scene: Scene, i: int, entity: str) -> None:
    """Wheel `i` at its place in the body, with a spoke that shows its rotation."""
    radius, width = float(scene.vehicle.wheel_radius), float(scene.vehicle.wheel_width)
    turned, steered = scene.turned[:, i], scene.steering[:, i]
    attitude = np.stack([np.zeros_like(turned), turned, steered], axis=1)
    place = np.broadcast_to([*scene.vehicle.wheel_position[i], 0.0], attitude.shape)
    poses = rr.Transform3D.columns(translation=place, quaternion=_quaternion(attitude))
    stream.send_columns(entity, _times(scene), poses, strict=True)
    tyre = rr.Cylinders3D(
        lengths=width,
        radii=radius,
        rotation_axis_angles=rr.RotationAxisAngle(axis=[1, 0, 0], radians=np.pi / 2),
        colors=_rgb(_TYRE),
        fill_mode="solid",
    )
    sizes = [[1.5 * radius, 1.04 * width, 0.2 * radius]]
    spoke = rr.Boxes3D(sizes=sizes, colors=_rgb(_SPOKE), fill_mode="solid")
    stream.log(entity, tyre, static=True, strict=True)
    stream.log(f"{entity}/spoke", spoke, static=True, strict=True)


def _paths(stream: rr.RecordingStream, scene: Scene) -> None:
    log = partial(stream.log, static=True, strict=True)
    log("world/path", rr.LineStrips3D([scene.state[:, :3]], colors=_rgb(DRIVEN), radii=0.06))
    if scene.prediction:
        strips = scene.prediction.state[..., :3]
        log("world/predictions", rr.LineStrips3D(strips, colors=_rgb(PREDICTED), radii=0.08))


def _plots(stream: rr.RecordingStream, scene: Scene) -> None:
    for title, lines in panels(scene).items():
        for i, (name, values) in enumerate(lines.items()):
            entity, known = _entity("plots", title, name), np.isfinite(values)
            style = rr.SeriesLines(colors=_rgb(figures.line(i)[0]), names=name, widths=1.5)
            stream.log(entity, style, static=True, strict=True)
            columns = rr.Scalars.columns(scalars=values[known])
            stream.send_columns(entity, _times(scene, known), columns, strict=True)


def _times(scene: Scene, shown: np.ndarray | slice = slice(None)) -> list[rr.TimeColumn]:
    """Both time lines of some of the states: steps, and seconds."""
    return [
        rr.TimeColumn("step", sequence=np.arange(scene.steps + 1)[shown]),
        rr.TimeColumn("time", duration=scene.seconds[shown]),
    ]


def _quaternion(rpy: np.ndarray) -> np.ndarray:
    """Roll, pitch, yaw `[..., 3]` to x, y, z, w `[..., 4]`."""
    return np.roll(geometry.rotation_from_rpy(jnp.asarray(rpy, jnp.float32)).wxyz, -1, axis=-1)


def _entity(*parts: str) -> str:
    return rr.new_entity_path(list(parts))


def _rgb(colour: str) -> tuple[int, int, int]:
    """A colour such as #0072B2 as three numbers up to 255."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue
