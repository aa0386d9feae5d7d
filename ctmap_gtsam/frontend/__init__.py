"""What filter and smoother share: keyframes, surfaces, tracks, scoring on depth, proposals."""
