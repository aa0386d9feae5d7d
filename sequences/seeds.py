"""Random numbers that depend on what they are for, never on the order in which work is done.

Every draw comes from ``SeedSequence(seed, stage, object, keyframe)``, so that a method gives the same answer
alone, inside ``ctmap compare``, in any order and on any number of workers.
"""

from __future__ import annotations

import zlib

import numpy as np


def generator(seed: int, stage: str, object_id: int = 0, keyframe: int = 0) -> np.random.Generator:
    """The generator of one stage for one object at one keyframe.

    Args:
        seed: the run's seed, >= 0.
        stage: a name, such as "filter.birth"; hashed with CRC-32, which is stable between Python processes.
        object_id: >= 0; 0 where the stage has no object.
        keyframe: >= 0; 0 where the stage has no keyframe.
    """
    entropy = (seed, zlib.crc32(stage.encode()), object_id, keyframe)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(entropy)))
