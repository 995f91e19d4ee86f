"""What the paper reports (Tables I and II): 16-step position errors, m, on drives of its own.

By the rows of `configs/rows`: a configuration's name, and which of its models. A specialist that
has seen one kind of ground is reported on that alone.
"""

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
