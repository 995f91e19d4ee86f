"""Prediction errors as rows: by vehicle, kind of ground and speed, also as a share of the way."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import islice, product

import numpy as np

from vertiwm_jax.evaluation import prediction
from vertiwm_jax.evaluation.prediction import Interval, TestWindows
from vertiwm_jax.evaluation.tables import markdown
from vertiwm_jax.learning import windows
from vertiwm_jax.state import STEP_SECONDS, VehicleState

SPEEDS = {
    "below -0.5": (-np.inf, -0.5),
    **{f"{low:g}-{high:g}": (low, high) for low, high in ((0.5, 2), (2, 4), (4, 6), (6, 8))},
}
"""Bins of the mean recorded forward speed over the predicted steps, m/s; a window that stands, or
is faster, is in none."""
LEAST_WAY = 2.0
"""m that a window has to drive for its error to be told as a share of its way."""
FAR = 0.1
"""Share of the way from which on an error is far off."""
ALL = "all"
"""Names rows that are of all vehicles, or of all kinds of ground."""
_TOLD = 15
"""Fields of a row that a JSON file has; the others are in the CSV file alone."""


@dataclass(frozen=True)
class ErrorRow:
    """Mean errors of a model in one group of windows.

    speed_bin: of `SPEEDS`; None for windows of any speed. horizon: steps. share_of_way: mean
    position error over mean distance driven, and beyond_10_percent: share of windows that err by
    more than that, both of windows that drive `LEAST_WAY` or more, and None without any. The last
    of the fields are quantiles of the position error, and windows whose prediction is not finite.
    """

    model: str
    vehicle: str
    subset: str
    split: str
    speed_bin: str | None
    horizon: int
    windows: int
    position_m: float
    position_m_low: float
    position_m_high: float
    share_of_way: float | None
    heading_rad: float
    tilt_rad: float
    speed_m_s: float
    beyond_10_percent: float | None
    horizontal_m: float
    height_m: float
    position_m_median: float
    position_m_90_percent: float
    position_m_99_percent: float
    diverged: int


def groups(test: TestWindows) -> Iterator[tuple[str, str, str | None, np.ndarray]]:
    """Vehicle, kind of ground, bin of speed and `[N]` bool, of every group that has windows.

    Rows of all vehicles stand beside those of each where there are several.
    """
    every = np.ones(len(test.drive), bool)
    state = np.asarray(test.windows.state)[:, test.windows.context + 1 :]
    speed = state[..., 6].mean(axis=1)
    bins = {name: (low <= speed) & (speed < high) for name, (low, high) in SPEEDS.items()}
    vehicles = {name: test.vehicle == name for name in np.unique(test.vehicle).tolist()}
    vehicles = {ALL: every, **vehicles} if len(vehicles) > 1 else vehicles
    grounds, speeds = {ALL: every, **test.of_ground}, {None: every, **bins}
    for vehicle, ground, speed_bin in product(vehicles, grounds, speeds):
        members = vehicles[vehicle] & grounds[ground] & speeds[speed_bin]
        if members.any():
            yield vehicle, ground, speed_bin, members


def rows(name: str, predicted: VehicleState, test: TestWindows, split: str) -> list[ErrorRow]:
    """Errors after the last step, a row for each of the `groups`.

    Args:
        name, split: of the model, and of the drives.
        predicted: leaves `[N, K, 3]`.
        test: the N windows.
    """
    found, lost = prediction.absolute_errors(predicted, test)
    last = {measure: error[:, -1] for measure, error in found.items()}
    position = last["position"]
    path = np.asarray(test.windows.state, float)[:, test.windows.context :, :3]
    way = windows.way(path)
    made = []
    for vehicle, ground, speed_bin, of in groups(test):
        interval = prediction.bootstrap(position[of], test.drive[of])
        median, most, nearly_all = np.quantile(position[of], (0.5, 0.9, 0.99)).tolist()
        far = of & (way >= LEAST_WAY)
        mean = {measure: float(error[of].mean()) for measure, error in last.items()}
        made.append(
            ErrorRow(
                model=name,
                vehicle=vehicle,
                subset=ground,
                split=split,
                speed_bin=speed_bin,
                horizon=predicted.position.shape[1],
                windows=int(of.sum()),
                position_m=interval.mean,
                position_m_low=interval.low,
                position_m_high=interval.high,
                share_of_way=float(position[far].mean() / way[far].mean()) if far.any() else None,
                heading_rad=mean["heading"],
                tilt_rad=mean["tilt"],
                speed_m_s=mean["speed"],
                beyond_10_percent=(
                    float((position[far] > FAR * way[far]).mean()) if far.any() else None
                ),
                horizontal_m=mean["horizontal"],
                height_m=mean["height"],
                position_m_median=median,
                position_m_90_percent=most,
                position_m_99_percent=nearly_all,
                diverged=int(lost[of].sum()),
            )
        )
    return made


def table(found: Sequence[ErrorRow]) -> str:
    """Rows of one horizon as Markdown: all windows, and those of a ground, a vehicle or a speed."""
    several = any(row.vehicle == ALL for row in found)
    told: dict[tuple[int, str], list[dict[str, str]]] = {}
    for row in found:
        speed = f"{row.speed_bin} m/s" if row.speed_bin else ALL
        common = row.subset, row.vehicle if several else ALL, speed
        named = [(place, name) for place, name in enumerate(common) if name != ALL]
        if len(named) > 1:
            continue
        group = named[0] if named else (-1, ALL)
        interval = Interval(row.position_m, row.position_m_low, row.position_m_high)
        quantiles = row.position_m_median, row.position_m_90_percent, row.position_m_99_percent
        told.setdefault(group, []).append(
            {
                "windows": f"{group[1]} (n = {row.windows})",
                "model": row.model,
                "position, m": str(interval),
                "50 / 90 / 99 % below, m": " / ".join(f"{x:.3f}" for x in quantiles),
                "of the way": _percent(row.share_of_way),
                "beyond 10 % of it": _percent(row.beyond_10_percent),
                "heading, rad": f"{row.heading_rad:.3f}",
                "tilt, rad": f"{row.tilt_rad:.4f}",
                "speed, m/s": f"{row.speed_m_s:.3f}",
                "diverged": f"{row.diverged}",
            }
        )
    steps = found[0].horizon
    title = f"Errors after {steps} steps ({STEP_SECONDS * steps:.3g} s), by group of windows"
    ordered = sorted(told.items(), key=lambda group: group[0][0])
    return f"{title}\n\n{markdown([row for _, rows in ordered for row in rows])}"


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f} %"


def json_text(found: Sequence[ErrorRow]) -> str:
    """Rows as a JSON list of objects."""
    told = [dict(islice(asdict(row).items(), _TOLD)) for row in found]
    return json.dumps(told, indent=1) + "\n"
