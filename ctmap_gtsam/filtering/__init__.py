"""The paper's particle filter (Algorithm 1): each keyframe sees only the past."""
