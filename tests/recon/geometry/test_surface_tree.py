"""The nearest of a surface's points, against all of them one by one."""

import os
import signal
import threading

import numba
import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from recon.geometry.surface_tree import nearest, surface_tree


def test_the_nearest_is_the_nearest(rng):
    """From afar, from beside the surface, and from its points themselves."""
    x, y = rng.uniform(-20, 20, (2, 2000))
    points = np.column_stack([x, y, 0.01 * x * x - 0.02 * x * y])
    raised = np.array([0.0, 0.0, 15.0])
    places = np.concatenate([points[:50] + raised, points[50:100] + rng.normal(0, 1, (50, 3)), points[100:110]])
    distance, chosen = nearest(surface_tree(points), places)
    every = cdist(places, points)
    assert (chosen == every.argmin(axis=1)).all()
    assert np.allclose(distance, every.min(axis=1))


@pytest.mark.parametrize("threads", [1, 3])
def test_several_are_the_nearest_within_reach(rng, monkeypatch, threads):
    """Of each place in its own order, however many threads search; beyond the reach there is none."""
    monkeypatch.setattr(numba, "get_num_threads", lambda: threads)
    points, places = rng.uniform(0, 10, (200, 3)), rng.uniform(0, 10, (101, 3))
    distances, chosen = nearest(KDTree(points), places, 4, farthest=1.5)
    every = cdist(places, points)
    wanted = np.sort(every)[:, :4]
    assert np.allclose(distances, np.where(wanted <= 1.5, wanted, np.inf))
    assert (chosen == np.where(wanted <= 1.5, every.argsort()[:, :4], 200)).all()
    assert 0.2 < (wanted <= 1.5).mean() < 0.9


def test_after_an_interrupt_nobody_searches_on(rng, monkeypatch):
    """A search of a second, interrupted after a tenth: what it began is ended when the interrupt is seen."""
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)
    tree, places = KDTree(rng.uniform(0, 10, (100_000, 3))), rng.uniform(0, 10, (1_000_000, 3))
    searching, query = [], KDTree.query

    def counted(*given, **options):
        searching.append(threading.get_ident())
        found = query(*given, **options)
        searching.remove(threading.get_ident())
        return found

    monkeypatch.setattr(KDTree, "query", counted)
    before, running = signal.signal(signal.SIGINT, signal.default_int_handler), set(threading.enumerate())
    try:
        with pytest.raises(KeyboardInterrupt):
            threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
            nearest(tree, places, 5)
    finally:
        signal.signal(signal.SIGINT, before)
    others = {thread.name.partition("_")[0] for thread in set(threading.enumerate()) - running if thread.is_alive()}
    assert others <= {"kernel"} and searching in ([], [threading.get_ident()])
