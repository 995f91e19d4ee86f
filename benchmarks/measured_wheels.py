"""How far the wheel in soil is from 270 measured trials, also at slip angles it was not fitted to.

Soil and contact are fitted for a smooth and a lugged wheel, to all slip angles but one, and judged
on that one, each in turn. Every row settles under the measured load. Errors are medians of
|predicted / measured - 1|, of forces where more than 1 N was measured.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from benchmarks._harness import parser, report
from vertiwm_jax import figures
from vertiwm_jax.evaluation import tables
from vertiwm_jax.mechanics.bekker_wong import (
    LUGGED_WHEEL,
    SMOOTH_WHEEL,
    BekkerWongParams,
    Ploughing,
)
from vertiwm_jax.mechanics.equilibrium import equilibrium_sinkage
from vertiwm_jax.mechanics.wheel import SoilContact, Wheel
from vertiwm_jax.terrain.soil import PRESETS, Soil

TRIALS = Path(__file__).parents[1] / "data" / "wheels" / "cmu_trials.csv"
RADIUS, WIDTH, LUGS = 0.058, 0.050, 0.005  # m
UNIT_WEIGHT = 13.03e3
CREEP = 1e-5  # m/s; the carriage moves at 0.01 m/s
REPEATS = 3
"""Trials of a kind: what they have in common is not better known for that."""
QUANTITIES = ("along", "across", "sinkage")


class Trials(NamedTuple):
    """Trials of one wheel: inputs `[N]` and what was measured.

    slip_angle: deg. slip: of the rim against the carriage, positive driven. hub, rim: m/s.
    load: N. measured: `[N, 3]`, force along and across the wheel, N, and sinkage, mm.
    """

    slip_angle: np.ndarray
    slip: np.ndarray
    hub: np.ndarray
    rim: np.ndarray
    load: np.ndarray
    measured: np.ndarray


class Fitted(NamedTuple):
    """A soil and a contact that were fitted together."""

    soil: Soil
    contact: BekkerWongParams


WHEELS = {
    "smooth": (
        Wheel(RADIUS, WIDTH),
        Fitted(PRESETS["sand_smooth_wheel"], SMOOTH_WHEEL.replace(creep_speed=CREEP)),
    ),
    # Lugs carry like a rim at half their height.
    "grouser": (
        Wheel(RADIUS + LUGS / 2, WIDTH),
        Fitted(PRESETS["sand_lugged_wheel"], LUGGED_WHEEL.replace(creep_speed=CREEP)),
    ),
}
AUTHORS_SOIL = Soil(*map(np.float32, (0, 8e6, 1.46, 1e3, np.deg2rad(29), 0.021, UNIT_WEIGHT)))
WITHOUT = Fitted(AUTHORS_SOIL, BekkerWongParams(creep_speed=CREEP))
"""The sand as measured by the authors, without `Ploughing`."""
AUTHORS = {
    0: (0.2024, 0.7048, -0.4760, -0.0003),
    30: (0.5697, 0.1993, -0.5076, -0.0097),
}
"""The authors' peak, peak_slip, exit and exit_slip, tuned to each slip angle (2024)."""


class Driven(NamedTuple):
    """Driven wheels that others measured: slips, pull in N and sinkage in mm, all `[N]`."""

    wheel: Wheel
    like: str
    load: float
    slip: tuple[float, ...]
    pull: tuple[float, ...]
    sinkage: tuple[float, ...]


_DING = (0, 0.1, 0.2, 0.3, 0.4, 0.6)
ELSEWHERE = {
    "Ding 2011, smooth": Driven(
        Wheel(0.15735, 0.165),
        "smooth",
        80,
        _DING,
        (-6.5, 11, 14.5, 15, 15, 15),
        (5, 5.5, 7.5, 10, 12.5, 17.5),
    ),
    "Ding 2011, 30 lugs of 10 mm": Driven(
        Wheel(0.16235, 0.165),
        "grouser",
        80,
        _DING,
        (-6.5, 14, 20, 22, 23, 24.5),
        (4.5, 5, 7.5, 10.5, 14, 27),
    ),
    "Hurrell 2025, 14 lugs of 20 mm": Driven(
        Wheel(0.11, 0.08),
        "grouser",
        24.5,
        (0.1, 0.2, 0.3, 0.4, 0.5),
        (8.1, 8.6, 8.8, 9.6, 10.5),
        (6, 9.5, 11, 16, 19.5),
    ),
}


def authors(name: str, angle: float) -> Fitted:
    """The authors' model of a wheel at a slip angle of 0 or 30 deg."""
    peak, peak_slip, leave, exit_slip = AUTHORS[int(angle)]
    contact = BekkerWongParams(
        peak=peak,
        peak_slip=peak_slip,
        exit=leave,
        exit_slip=exit_slip,
        slip_sinkage=0.01,
        skid_sinkage={"smooth": 0.55, "grouser": 0.74}[name],
        creep_speed=CREEP,
        bulldozing="wong",
    )
    return Fitted(AUTHORS_SOIL, contact)


@dataclass(frozen=True)
class Prior:
    """What a parameter is expected to be: `middle`, give or take `spread`, as a factor if `log`."""

    middle: float
    spread: float
    log: bool = False

    def value(self, x: jax.Array) -> jax.Array:
        return self.middle * jnp.exp(self.spread * x) if self.log else self.middle + self.spread * x


PRIORS = {
    # The authors measured kphi, n, c and K of this sand, and a friction angle of 29 deg inside it;
    # between sand and wheel there is less.
    "kphi": Prior(8e6, 0.7, log=True),
    "n": Prior(1.46, 0.1),
    "cohesion": Prior(1e3, 0.7, log=True),
    "friction_angle": Prior(0.45, 0.07),
    "shear_modulus": Prior(0.01, 0.5, log=True),
    "peak": Prior(0.25, 0.1),
    "peak_slip": Prior(0.0, 0.2),
    "exit": Prior(-0.2, 0.1),
    "soft_aside": Prior(2.5, 0.4, log=True),
    "soft_slip": Prior(3.5, 0.4, log=True),
    "soft_skid": Prior(5.0, 0.4, log=True),
    "peak_aside": Prior(0.22, 0.1),
    "peak_skid": Prior(0.5, 0.1),
    "forward": Prior(0.05, 0.4, log=True),
    "side": Prior(1.0, 0.4, log=True),
    "side_slip": Prior(0.4, 0.2),
}


def read(path: Path) -> dict[str, Trials]:
    """Trials by wheel."""
    table = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
    trials = {}
    for name in WHEELS:
        rows = table[table["wheel"] == name]
        measured = np.stack([rows["along_n"], rows["across_n"], rows["sinkage_mm"]], axis=-1)
        hub, rim = rows["carriage_speed_mm_s"] / 1e3, rows["rim_speed_mm_s"] / 1e3
        trials[name] = Trials(rows["beta_deg"], rows["slip"], hub, rim, rows["load_n"], measured)
    return trials


def predicted(wheel: Wheel, soil: Soil, contact: SoilContact, trials: Trials) -> jax.Array:
    """`[N, 3]`, as `Trials.measured`, of wheels that settle under their load."""
    angle = jnp.deg2rad(trials.slip_angle)
    motion = (
        trials.hub * jnp.cos(angle),
        -trials.hub * jnp.sin(angle),  # the soil pushes to the left
        trials.rim / RADIUS,
    )
    sinkage = equilibrium_sinkage(wheel, soil, contact, trials.load, motion)
    f = contact.forces(wheel, soil, sinkage, motion)
    return jnp.stack([f.longitudinal, f.lateral, 1e3 * sinkage], axis=-1)


def errors(got: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """`[N, 3]`, relative; NaN where a force of less than 1 N (a sinkage of 1 mm) was measured."""
    return np.where(np.abs(measured) > 1, np.abs(got / measured - 1), np.nan)


def build(x: jax.Array) -> Fitted:
    """Soil and contact from `[16]` numbers in spreads from their priors' middles."""
    v = {name: prior.value(x[i]) for i, (name, prior) in enumerate(PRIORS.items())}
    fields = ("kphi", "n", "cohesion", "friction_angle", "shear_modulus")
    soil = Soil(
        kc=jnp.float32(0), unit_weight=jnp.float32(UNIT_WEIGHT), **{k: v[k] for k in fields}
    )
    ploughing = Ploughing(**{k: v[k] for k in Ploughing.__dataclass_fields__})
    known = {k: v[k] for k in ("peak", "peak_slip", "exit")}
    return Fitted(soil, BekkerWongParams(**known, creep_speed=CREEP, ploughing=ploughing))


def fitter(wheel: Wheel, trials: Trials) -> Callable[[np.ndarray], Fitted]:
    """A function that fits to those trials that a mask `[N]` keeps, compiled once."""
    measured = jnp.asarray(trials.measured)
    # Beside what is wanted of each; of forces below 1.5 N only the absolute errors count, and
    # large errors count less than by their squares.
    scale = jnp.asarray([0.07, 0.12, 0.15]) * jnp.maximum(
        jnp.abs(measured), jnp.asarray([1.5, 1.5, 0.0])
    )
    # A locked wheel that is dragged straight to its side was pulled back by 7 N along itself,
    # which no symmetric wheel feels: the rig's forces along are not trusted there.
    scale = scale * jnp.where((trials.slip_angle == 90)[:, None], jnp.asarray([7.0, 1, 1]), 1.0)

    def residuals(x: jax.Array, kept: jax.Array) -> jax.Array:
        e = (predicted(wheel, *build(x), trials) - measured) / scale
        robust = jnp.sign(e) * jnp.sqrt(2 * (jnp.sqrt(1 + e**2) - 1) + 1e-9)
        return jnp.concatenate([(kept[:, None] * robust / REPEATS**0.5).ravel(), x])

    value, slope = jax.jit(residuals), jax.jit(jax.jacfwd(residuals))

    def fit(kept: np.ndarray) -> Fitted:
        def of(function: Callable[..., jax.Array]) -> Callable[[np.ndarray], np.ndarray]:
            return lambda x: np.asarray(function(jnp.float32(x), jnp.float32(kept)), float)

        found = least_squares(
            of(value), np.zeros(len(PRIORS)), jac=of(slope), ftol=1e-4, xtol=1e-4, max_nfev=60
        )
        return jax.tree.map(np.asarray, build(jnp.asarray(found.x, jnp.float32)))

    return fit


def held_out(wheel: Wheel, trials: Trials) -> np.ndarray:
    """`[N, 3]` predictions of each slip angle by what was fitted to the others."""
    fit, predict = fitter(wheel, trials), jax.jit(predicted)
    got = np.zeros_like(trials.measured)
    for angle in np.unique(trials.slip_angle):
        out = trials.slip_angle == angle
        got[out] = np.asarray(predict(wheel, *fit(~out), trials))[out]
    return got


def repeated(trials: Trials) -> np.ndarray:
    """`[N, 3]`, the mean of a trial's repetitions: nothing predicts a trial better than this."""
    kind = np.round(20 * trials.slip) + 100 * trials.slip_angle
    got = np.full_like(trials.measured, np.nan)
    for i, own in enumerate(kind):
        others = kind == own
        others[i] = False
        if others.any():
            got[i] = trials.measured[others].mean(axis=0)
    return got


def table(trials: Trials, found: dict[str, np.ndarray]) -> dict[str, dict[str, str]]:
    """By model, medians of errors in per cent (along / across / sinkage) by slip angle."""

    def told(e: np.ndarray) -> str:
        seen = (~np.isnan(e)).sum(axis=0) > 5
        return " / ".join(
            f"{100 * np.nanmedian(e[:, i]):.0f}" if seen[i] else "-" for i in range(3)
        )

    angles = {
        f"{angle:.0f} deg": trials.slip_angle == angle for angle in np.unique(trials.slip_angle)
    }
    groups = angles | {"all but 90 deg": trials.slip_angle < 90, "all": trials.slip_angle >= 0}
    rows = {}
    for model, got in found.items():
        e = errors(got, trials.measured)
        rows[model] = {name: told(e[rows]) for name, rows in groups.items()}
    return rows


def picture(trials: Trials, found: dict[str, np.ndarray]):
    """Measured and held-out values over slip, a row of panels a slip angle."""
    angles = np.unique(trials.slip_angle)
    figure = figures.sheet(9.0, 2.0 * len(angles))
    panels = figure.subplots(len(angles), 3, sharex=True, squeeze=False)
    labels = ("force along, N", "force across, N", "sinkage, mm")
    for row, angle in zip(panels, angles, strict=True):
        of = np.flatnonzero(trials.slip_angle == angle)
        of = of[np.argsort(trials.slip[of])]
        for i, axes in enumerate(row):
            axes.plot(trials.slip[of], trials.measured[of, i], "k.", label="measured")
            for j, name in enumerate(("fitted", "held out", "without ploughing")):
                color, dash = figures.line(j)
                axes.plot(trials.slip[of], found[name][of, i], dash, color=color, label=name)
            axes.set_title(f"{labels[i]}, {angle:.0f} deg")
    for axes in panels[-1]:
        axes.set_xlabel("slip")
    panels[0, 0].legend()
    return figure


def elsewhere(driven: Driven) -> dict[str, str]:
    """Medians of errors in per cent, of pull and sinkage: of the wheel fitted here in its own sand,
    and once modulus, friction, K and `soft_slip` are fitted to the rows; and these as factors.
    """
    soil, contact = WHEELS[driven.like][1]
    slip = np.float32(driven.slip)
    one = np.ones_like(slip)
    measured = np.stack([driven.pull, driven.sinkage], axis=-1)
    rim = 0.01 * one * RADIUS / driven.wheel.radius  # `predicted` divides by the trials' radius
    trials = Trials(0 * one, slip, 0.01 * (1 - slip), rim, driven.load * one, measured)
    names = ("kphi", "friction_angle", "shear_modulus", "soft_slip")

    def changed(x: jax.Array) -> Fitted:
        by = dict(zip(names, jnp.exp(x), strict=True))
        own = {name: getattr(soil, name) * by[name] for name in names[:3]}
        softer = contact.ploughing.replace(soft_slip=contact.ploughing.soft_slip * by["soft_slip"])
        return Fitted(soil.replace(**own), contact.replace(ploughing=softer))

    @jax.jit
    def predict(x: jax.Array) -> jax.Array:
        return predicted(driven.wheel, *changed(x), trials)[:, jnp.asarray([0, 2])]

    def residuals(x: jax.Array) -> jax.Array:
        scale = 0.15 * jnp.maximum(jnp.abs(trials.measured), jnp.asarray([3.0, 0.0]))
        return jnp.concatenate([((predict(x) - trials.measured) / scale).ravel(), x])

    value, slope = jax.jit(residuals), jax.jit(jax.jacfwd(residuals))
    found = least_squares(
        lambda x: np.asarray(value(jnp.float32(x)), float),
        np.zeros(4),
        jac=lambda x: np.asarray(slope(jnp.float32(x)), float),
    )

    def told(x: np.ndarray) -> str:
        e = np.abs(np.asarray(predict(jnp.float32(x))) / trials.measured - 1)
        return " / ".join(f"{100 * m:.0f}" for m in np.median(e, axis=0))

    factors = {name: f"{f:.2f}" for name, f in zip(names, np.exp(found.x), strict=True)}
    return {"as fitted here": told(np.zeros(4)), "refitted": told(found.x), **factors}


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--data", type=Path, default=TRIALS)
    options.add_argument("--output", type=Path, help="folder for rows, tables and pictures")
    chosen = options.parse_args()
    predict = jax.jit(predicted)
    results, files = {}, {}
    for name, trials in read(chosen.data).items():
        wheel, shipped = WHEELS[name]
        theirs = np.full_like(trials.measured, np.nan)
        for angle in AUTHORS:
            own = trials.slip_angle == angle
            theirs[own] = np.asarray(predict(wheel, *authors(name, angle), trials))[own]
        found = {
            "repeated trials": repeated(trials),
            "fitted": np.asarray(predict(wheel, *shipped, trials)),
            "held out": held_out(wheel, trials),
            "authors": theirs,
            "without ploughing": np.asarray(predict(wheel, *WITHOUT, trials)),
        }
        fit = fitter(wheel, trials)(np.ones(len(trials.load)))
        if not chosen.json:
            print(f"{name}, fitted to all: {fit}")
        results |= {f"{name}, {model}": row for model, row in table(trials, found).items()}
        rows = []
        for i in range(len(trials.load)):
            row = {
                "slip_angle": trials.slip_angle[i],
                "slip": trials.slip[i],
                "load": trials.load[i],
            }
            for model, got in {"measured": trials.measured, **found}.items():
                row |= {f"{q} {model}": float(got[i, j]) for j, q in enumerate(QUANTITIES)}
            rows.append(row)
        files |= {f"{name}.csv": tables.csv_text(rows), f"{name}.png": picture(trials, found)}
    if chosen.output:
        tables.write(chosen.output, files)
    others = {name: elsewhere(driven) for name, driven in ELSEWHERE.items()}
    if chosen.json:
        report("measured_wheels", results | others, as_json=True)
    else:
        report("measured_wheels", results, as_json=False)
        report("other sands", others, as_json=False)


if __name__ == "__main__":
    main()
