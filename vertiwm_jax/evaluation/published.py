"""The figures of the paper, which are from its own drives and worlds."""

POSITION_ERRORS: dict[str, dict[str, float]] = {
    "protocol: vertiwm": {"rigid": 0.3655, "deformable": 0.6409, "transition": 0.5773},
    "protocol: transformer": {"rigid": 0.4385},
    "protocol: nesam": {"deformable": 0.8081},
    "exchanged: transformer": {"deformable": 0.9684},
    "exchanged: nesam": {"rigid": 0.6158},
    "mixed: transformer": {"rigid": 0.5310, "deformable": 0.8890, "transition": 0.8832},
    "mixed: nesam": {"rigid": 0.5630, "deformable": 0.7751, "transition": 0.7371},
    "everything: transformer": {"rigid": 0.3413, "deformable": 0.6964, "transition": 0.6518},
    "no_terrain: transformer": {"rigid": 0.4674, "deformable": 0.7905, "transition": 0.7522},
}
"""Tables I and II: 16-step position errors, m, by row of `configs/rows` (a configuration's name and
one of its models). A specialist of one kind of ground is reported on that ground alone.
"""

DRIVING: dict[str, str] = {
    "ppo in transformer": "17/20, 28.1 s, trained for 1.14 h",
    "ppo in nesam": "17/20, 29.7 s, trained for 1.01 h",
    "ppo in vertiwm": "19/20, 27.5 s, trained for 1.36 h (CPU: 20/20, 34.0 s, 3.98 h)",
    "td3 in vertiwm": "18/20, 32.2 s, trained for 1.35 h",
    "sac in vertiwm": "18/20, 31.3 s, trained for 1.55 h",
}
"""Table III, by the algorithm and model of a policy's training."""
