"""Learning while driving: a model's weights stay, what it is told of the ground does not."""
