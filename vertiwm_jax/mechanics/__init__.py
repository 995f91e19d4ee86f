"""Physics, nothing learned: wheels on soil and rock, vehicles, and the built-in simulator."""
