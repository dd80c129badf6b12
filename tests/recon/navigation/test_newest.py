"""The newest wins: a slow reader never sees what a newer thing has replaced."""

from threading import Thread
from time import monotonic, sleep

from recon.navigation.newest import Every, Newest
from tests.patience import PATIENCE_S


def test_a_slow_reader_takes_the_newest_of_all_that_came():
    place = Newest()
    for k in range(100):
        place.put(k)
    assert place.take(0.1) == 99
    assert place.replaced == 99
    assert place.take(0.0) is None


def test_a_reader_waits_for_what_comes_and_no_longer_than_it_said():
    place = Newest()
    Thread(target=lambda: (sleep(0.05), place.put("now"))).start()
    assert place.take(PATIENCE_S) == "now"
    start = monotonic()
    assert place.take(0.05) is None
    assert monotonic() - start >= 0.05


def test_an_end_wakes_who_waits():
    place = Newest()
    Thread(target=lambda: (sleep(0.05), place.close())).start()
    start = monotonic()
    assert place.take(PATIENCE_S) is None
    assert monotonic() - start < PATIENCE_S


def test_a_reader_that_must_miss_none_takes_all_in_their_order():
    """What came before the end is taken after it, too; of more than fit in the oldest go, and are counted."""
    place = Every(most=5)
    for k in range(4):
        place.put(k)
    place.close()
    assert [place.take(0.0) for _ in range(5)] == [0, 1, 2, 3, None] and place.replaced == 0
    for k in range(7):
        place.put(k)
    assert place.take(0.0) == 2 and place.replaced == 2
