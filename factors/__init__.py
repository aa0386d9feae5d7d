"""The potentials of the model, each once: pure batched NumPy functions with analytic Jacobians."""
