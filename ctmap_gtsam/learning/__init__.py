"""What the model takes for given, learned from runs: each with how well it is known."""
