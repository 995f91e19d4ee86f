"""The paper's method: two specialists and the gate that fuses them (Eqs. 1-8)."""
