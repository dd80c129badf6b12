"""Joining basins of continuous phase into regions, and giving these their absolute order by the centre line's votes."""

import heapq
from collections import Counter, defaultdict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CONTINUOUS = 0.85  # share of the common border of two basins that must be continuous for them to be one region
MOSTLY = 0.5  # likewise, where one basin of the one borders on one of the other like that, and all that is continuous agrees
VOTES = 5  # least rows with the line on a region
AGREEMENT = 0.85  # least share of the votes for one order

Integers = NDArray[np.int32]


@dataclass(frozen=True)
class Borders:
    """Contacts between basins: numbers of continuous ones by order offset (q less p), and of torn ones."""

    continuous: dict[tuple[int, int], Counter]  # (p, q), p < q
    torn: Counter  # of (p, q), p < q


@dataclass(frozen=True)
class Regions:
    """Basins joined to regions, and their orders."""

    region: Integers  # (count,) the region of each basin, named by one of its basins
    lift: Integers  # (count,) the order of each basin's root less that of its region's
    absolute: dict[int, int]  # the absolute order of each region's root, for regions with the line
    disputed: set[int]  # regions whose votes disagree, or that contradict themselves


def join(count: int, borders: Borders, votes: dict[int, Counter], broken: set[int]) -> Regions:
    """Join basins into regions over continuous borders, the longest first, and anchor them by the line's votes.

    Two basins with the line need no continuous border, only one contact that doesn't contradict their votes. A bust before a
    table is joined to it so, and torn off what lies behind; the table goes on around it: half of such a border is enough.

    Parameters
    ----------
    count : int, of basins
    borders : Borders
    votes : basin -> votes of the line for each absolute order of the basin's root
    broken : basins that contradict themselves; they join nothing

    Returns
    -------
    Regions
    """
    region, lift = np.arange(count, dtype=np.int32), np.zeros(count, np.int32)
    members = {p: [p] for p in range(count)}
    anchored = {p: order for p, tally in votes.items() if (order := _verdict(tally)) is not None}
    refused = broken | {p for p, tally in votes.items() if tally.total() >= VOTES and p not in anchored}
    links: dict[int, dict[int, Counter]] = defaultdict(dict)
    torn: dict[int, Counter] = defaultdict(Counter)
    for (p, q), offsets in borders.continuous.items():
        if not {p, q} & refused:
            links[p][q], links[q][p] = Counter(offsets), Counter({-k: n for k, n in offsets.items()})
    for (p, q), n in borders.torn.items():
        torn[p][q] += n
        torn[q][p] += n
    whole: dict[int, set[int]] = defaultdict(set)  # neighbours by a border that is continuous
    for p, its in links.items():
        whole[p] = {q for q, offsets in its.items() if max(offsets.values()) >= CONTINUOUS * (offsets.total() + torn[p][q])}

    def proposal(p: int, q: int) -> tuple[float, int] | None:
        """Strength of p and q as one surface, and the order of q's root less p's; None if they can't be."""
        offsets = links[p][q]
        if p in anchored and q in anchored:
            k = anchored[q] - anchored[p]
            return (offsets[k], k) if offsets[k] else None
        k, n = offsets.most_common(1)[0]
        share = n / (offsets.total() + torn[p][q])
        least = MOSTLY if q in whole[p] and n >= AGREEMENT * offsets.total() else CONTINUOUS
        return (n * share, k) if share >= least else None

    age = [0] * count
    queue: list[tuple[float, int, int, int]] = []

    def propose(p: int, q: int) -> None:
        if (found := proposal(p, q)) is not None:
            heapq.heappush(queue, (-found[0], p, q, age[p] + age[q]))

    for p, q in borders.continuous:
        if q in links[p]:
            propose(p, q)
    while queue:
        _, p, q, born = heapq.heappop(queue)
        if q not in links[p] or born != age[p] + age[q]:
            continue
        _, k = proposal(p, q) or (0, 0)
        if len(members[p]) < len(members[q]):
            p, q, k = q, p, -k
        for basin in members[q]:
            region[basin], lift[basin] = p, lift[basin] + k
        members[p] += members.pop(q)
        if q in anchored:
            anchored.setdefault(p, anchored.pop(q) - k)
        del links[p][q], links[q][p]
        for other in whole.pop(q, set()) - {p}:
            whole[p].add(other)
            whole[other].add(p)
        for other, n in torn.pop(q, Counter()).items():
            torn[p][other] += n
            torn[other][p] += n
        for other, offsets in links.pop(q).items():
            moved = Counter({step + k: n for step, n in offsets.items()})
            del links[other][q]
            links[p][other] = links[p].get(other, Counter()) + moved
            links[other][p] = Counter({-step: n for step, n in links[p][other].items()})
        age[p] += 1
        for other in links[p]:
            propose(p, other)

    absolute, disputed = {}, set()
    for name, basins in members.items():
        tally: Counter = Counter()
        for basin in basins:
            for order, n in votes.get(basin, Counter()).items():
                tally[order - int(lift[basin])] += n
        verdict = _verdict(tally)
        if refused & set(basins) or (verdict is None and tally.total() >= VOTES):
            disputed.add(name)
        elif verdict is not None:
            absolute[name] = verdict
    return Regions(region, lift, absolute, disputed)


def _verdict(tally: Counter) -> int | None:
    """The order of nearly all votes, None of too few or of votes that disagree."""
    if tally.total() < VOTES:
        return None
    order, n = tally.most_common(1)[0]
    return order if n >= AGREEMENT * tally.total() else None
