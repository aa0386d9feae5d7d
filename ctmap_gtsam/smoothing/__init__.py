"""The factor graph: every frame sees the whole run."""
