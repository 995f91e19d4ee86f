"""A learned policy apart from its training: as StableHLO, as ONNX, and in NumPy alone."""
