"""All settings, as one tree of frozen dataclasses; `ctmap config` prints it as commented TOML."""

from __future__ import annotations

from dataclasses import dataclass, field

from sequences.options import option


@dataclass(frozen=True)
class Keyframes:
    """Which frames the estimators use. A frame is a keyframe where it is the first of a visit or meets all three."""

    every: int = option(1, "use every n-th frame", low=1)
    min_translation_m: float = option(0.0, "and only after the camera moved so far, metres ...", low=0.0)
    min_rotation_rad: float = option(0.0, "... or turned so far, rad", low=0.0)


@dataclass(frozen=True)
class Config:
    """The whole tree."""

    seed: int = option(0, "every random draw depends on this and on what it is for, nothing else", low=0)
    keyframes: Keyframes = field(default_factory=Keyframes)
