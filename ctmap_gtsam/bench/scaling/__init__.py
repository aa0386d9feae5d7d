"""How long filter and smoother take and how much memory, against objects, particles and the length of the run."""
