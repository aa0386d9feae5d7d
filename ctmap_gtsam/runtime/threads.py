"""How many threads the libraries under us may start."""

from __future__ import annotations

import os

_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
ONE_THREAD = ("NUMBA_NUM_THREADS", *_POOLS)
"""environment variables that are 1 where a process is to have one thread in every library"""


def limit_library_threads() -> None:
    """One thread for each BLAS and OpenMP pool, unless the environment says otherwise; call it before importing NumPy.

    Our kernels are parallel over hypotheses by numba, and our matrices are small: a pool in every library
    would only have them fight for the same cores, and a sum split over threads depends on their number.
    """
    for name in _POOLS:
        os.environ.setdefault(name, "1")
    # threads that wait for work spin by default, and on a busy machine take the core from those that have some
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # once Open3D is loaded numba finds its TBB, which is too old, and warns of it
    os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp workqueue tbb")


def cores() -> int:
    """How many threads, or processes of one thread, may work at once.

    Numba's number: NUMBA_NUM_THREADS, the cores that this process may use where it isn't set.
    """
    import numba

    return int(numba.get_num_threads())
