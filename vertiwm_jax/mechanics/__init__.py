"""Physics without learned parts: wheels on soil and rock, vehicles, and the simulator."""
