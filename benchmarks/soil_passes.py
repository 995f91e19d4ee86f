"""A wheel that rolls over the same soil again and again, in Chrono's SCM and by our equations.

`--record` drives the wheel in Project Chrono and writes `tests/data/scm_passes.csv`: a cylinder of
the HMMWV's size and load, whose speed and spin are given while it may rise and sink, on level soil
whose nodes are 0.1 m apart. At a slip of s it drives at (1 - s) times the speed of its rim.
"""

import csv
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks._harness import Figures, parser, report
from vertiwm_jax.mechanics.equilibrium import equilibrium_sinkage
from vertiwm_jax.mechanics.scm import ScmParams
from vertiwm_jax.mechanics.simulator import chrono_like
from vertiwm_jax.mechanics.vehicle import load_vehicle
from vertiwm_jax.mechanics.wheel import Float, SoilContact, Wheel, WheelForces
from vertiwm_jax.simulators.chrono import STEP, modules
from vertiwm_jax.simulators.chrono_ground import BULLDOZING, CELL, DAMPING, ELASTICITY
from vertiwm_jax.terrain.soil import PRESETS, stack

FILE = Path(__file__).parents[1] / "tests" / "data" / "scm_passes.csv"
RADIUS, WIDTH, LOAD, SPEED = 0.467, 0.254, 6093.0, 1.0
SLIPS = (-0.1, 0.0, 0.1, 0.2, 0.4)
PASSES = 3
LENGTH, AWAY = 7.0, 2.0
"""m of a pass, and of its beginning that does not count."""
STEADY, STIFFENING = ScmParams(creep_speed=0.02, fresh_speed=0.3), 2.8
"""Contact, and factor on Bekker's moduli, of a wheel that rolls steadily on nodes 0.1 m apart: by
the medians of the table. Those of `chrono_like` are fitted to vehicles that bounce."""


class Pass(NamedTuple):
    """Means of a pass: sinkage, m; force along, N; moment of the soil about the axle, N m."""

    soil: str
    slip: float
    number: int
    sinkage: float
    pull: float
    torque: float


def in_chrono(name: str, slip: float) -> Iterator[Pass]:
    """The passes of a wheel in SCM's soil."""
    chrono, vehicle = modules()
    soil, vector = PRESETS[name], chrono.ChVector3d
    system = chrono.ChSystemNSC()
    system.SetGravitationalAcceleration(vector(0, 0, -9.81))
    system.SetCollisionSystemType(chrono.ChCollisionSystem.Type_BULLET)
    ground = vehicle.SCMTerrain(system, False)
    numbers = soil.kphi, soil.kc, soil.n, soil.cohesion
    angle = float(np.degrees(soil.friction_angle))
    ground.SetSoilParameters(
        *map(float, numbers), angle, float(soil.shear_modulus), ELASTICITY[name], DAMPING
    )
    ground.EnableBulldozing(True)
    ground.SetBulldozingParameters(*BULLDOZING)
    ground.Initialize(LENGTH + 4, 4.0, CELL)
    wheel = chrono.ChBody()
    wheel.SetMass(LOAD / 9.81)
    wheel.SetInertiaXX(vector(50, 50, 50))
    across = chrono.ChFramed(chrono.VNULL, chrono.QuatFromAngleX(np.pi / 2))
    shape = chrono.ChCollisionShapeCylinder(chrono.ChContactMaterialNSC(), RADIUS, WIDTH)
    wheel.AddCollisionShape(shape, across)
    wheel.EnableCollision(True)
    system.AddBody(wheel)
    ground.AddMovingPatch(wheel, chrono.VNULL, vector(1.2, 0.6, 1.2))
    spin = SPEED / (1 - slip) / RADIUS
    for number in range(1, PASSES + 1):
        wheel.SetPos(vector(-LENGTH / 2, 0, RADIUS))
        wheel.SetRot(chrono.QUNIT)
        wheel.SetPosDt(vector(SPEED, 0, 0))
        found = []
        while wheel.GetPos().x < LENGTH / 2:
            wheel.SetPosDt(vector(SPEED, 0, wheel.GetPosDt().z))
            wheel.SetAngVelLocal(vector(0, spin, 0))
            system.DoStepDynamics(STEP)
            force, moment = vector(), vector()
            if ground.GetContactForceBody(wheel, force, moment):
                found.append((wheel.GetPos().x, RADIUS - wheel.GetPos().z, force.x, -moment.y))
        x, *means = np.array(found).T
        counted = x > AWAY - LENGTH / 2
        yield Pass(name, slip, number, *(float(np.mean(each[counted])) for each in means))


def modeled(
    cases: Sequence[tuple[str, float]],
    contact: SoilContact = STEADY,
    stiffening: Float = STIFFENING,
) -> list[Pass]:
    """The passes by the equations of this package: each finds the rut of the ones before."""
    soil = stack([PRESETS[name] for name, _ in cases])
    soil = replace(soil, kc=stiffening * soil.kc, kphi=stiffening * soil.kphi)
    slip = jnp.array([slip for _, slip in cases])
    motion, wheel = (SPEED, 0.0, SPEED / (1 - slip) / RADIUS), Wheel(RADIUS, WIDTH)

    @jax.jit
    def roll(rut: jax.Array) -> tuple[jax.Array, WheelForces]:
        sinkage = equilibrium_sinkage(wheel, soil, contact, LOAD, motion, rut)
        return sinkage, contact.forces(wheel, soil, sinkage, motion, rut)

    found, rut = [], jnp.zeros(len(cases))
    for number in range(1, PASSES + 1):
        sinkage, forces = roll(rut)
        every = map(np.asarray, (sinkage, forces.longitudinal, forces.torque))
        for case, *of_it in zip(cases, *every, strict=True):
            found.append(Pass(*case, number, *map(float, of_it)))
        rut = jnp.maximum(rut, sinkage)
    return found


def errors(found: Sequence[Pass], number: int) -> dict[str, float]:
    """Medians over soils and slips in a pass: of sinkage, pull and torque, as a share of SCM's.

    Forces below a twentieth of the load count as that much, and torques as those of such forces.
    """
    ours = {each[:3]: each for each in found}
    pairs = [(each, ours[each[:3]]) for each in recorded() if each.number == number]
    told = {}
    for name, least in (("sinkage", 0.0), ("pull", LOAD / 20), ("torque", LOAD * RADIUS / 20)):
        of_each = [
            abs(getattr(own, name) - getattr(each, name)) / max(abs(getattr(each, name)), least)
            for each, own in pairs
        ]
        told[name] = float(np.median(of_each))
    return told


def recorded() -> list[Pass]:
    """What `--record` wrote."""
    with FILE.open() as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    kinds = Pass.__annotations__
    return [Pass(**{name: kinds[name](row[name]) for name in kinds}) for row in rows]


def record() -> None:
    rows = [each for name in ELASTICITY for slip in SLIPS for each in in_chrono(name, slip)]
    with FILE.open("w", newline="") as file:
        file.write("# Chrono 9.0.1: python -m benchmarks.soil_passes --record\n")
        writer = csv.writer(file)
        writer.writerow(Pass._fields)
        writer.writerows([each[:3] + tuple(f"{x:.6g}" for x in each[3:]) for each in rows])


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--record", action="store_true", help="needs PyChrono")
    chosen = options.parse_args()
    if chosen.record:
        record()
    cases = list(dict.fromkeys((each.soil, each.slip) for each in recorded()))
    found, simulator = modeled(cases), chrono_like(load_vehicle())
    every = {
        "medians of errors": found,
        "medians with the simulator's numbers": modeled(
            cases, simulator.contact, simulator.stiffening
        ),
    }
    results: dict[str, Figures] = {}
    for title, passes in every.items():
        for number in range(1, PASSES + 1):
            medians = {f"{name}, %": 100 * x for name, x in errors(passes, number).items()}
            results[f"pass {number}: {title}"] = medians
    ours = {each[:3]: each for each in found}
    for each in recorded():
        own = ours[each[:3]]
        results[f"{each.soil}, slip {each.slip}, pass {each.number}"] = {
            "sinkage, mm": 1e3 * own.sinkage,
            "in SCM, mm": 1e3 * each.sinkage,
            "pull, N": own.pull,
            "in SCM, N": each.pull,
            "torque, N m": own.torque,
            "in SCM, N m": each.torque,
        }
    report("soil_passes", results, chosen.json)


if __name__ == "__main__":
    main()
