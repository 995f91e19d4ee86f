"""How good a model or a policy is: prediction errors, navigation results, plots."""
