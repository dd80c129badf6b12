"""Linear algebra on one thread. On several, BLAS adds up in another order, and its last digits differ."""

from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


@contextmanager
def on_one_thread() -> Iterator[None]:
    """Let BLAS add up in one order meanwhile, for the same bits whoever has loaded NumPy, and with how many threads.

    OPENBLAS_NUM_THREADS alone doesn't do: it counts when NumPy is loaded, and a notebook or a script has loaded it before it
    calls ours. Most builds of OpenBLAS have one number for all of the process: where two threads overlap in this, the former
    one comes back with the first that leaves.
    """
    with threadpool_limits(1, "blas"):
        yield
