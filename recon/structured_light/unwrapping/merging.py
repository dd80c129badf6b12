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


@dataclass(frozen=True)
class _Border:
    """Contacts of a region with another one."""

    continuous: Counter  # by order offset, the other's root less this one's
    torn: int
    whole: bool  # continuous between one basin of each

    def joined(self, other: "_Border", step: int) -> "_Border":
        """With those of a region that joins this one, whose root is `step` orders higher."""
        continuous = self.continuous + Counter({k + step: n for k, n in other.continuous.items()})
        return _Border(continuous, self.torn + other.torn, self.whole or other.whole)

    def turned(self) -> "_Border":
        """As the other has it."""
        return _Border(Counter({-k: n for k, n in self.continuous.items()}), self.torn, self.whole)


NO_BORDER = _Border(Counter(), 0, False)


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
    bordering: dict[int, dict[int, _Border]] = defaultdict(dict)
    for p, q in dict.fromkeys((*borders.continuous, *borders.torn)):
        offsets, torn = borders.continuous.get((p, q), Counter()), borders.torn[p, q]
        if not {p, q} & refused:
            whole = max(offsets.values(), default=0) >= CONTINUOUS * (offsets.total() + torn)
            bordering[p][q] = border = _Border(offsets, torn, whole)
            bordering[q][p] = border.turned()

    def proposal(p: int, q: int) -> tuple[float, int] | None:
        """Strength of p and q as one surface, and the order of q's root less p's; None if they can't be."""
        border = bordering[p][q]
        if not border.continuous:
            return None
        if p in anchored and q in anchored:
            k = anchored[q] - anchored[p]
            return (border.continuous[k], k) if border.continuous[k] else None
        (k, n), total = border.continuous.most_common(1)[0], border.continuous.total()
        share = n / (total + border.torn)
        least = MOSTLY if border.whole and n >= AGREEMENT * total else CONTINUOUS
        return (n * share, k) if share >= least else None

    age = [0] * count
    queue: list[tuple[float, int, int, int]] = []

    def propose(p: int, q: int) -> None:
        if (found := proposal(p, q)) is not None:
            heapq.heappush(queue, (-found[0], p, q, age[p] + age[q]))

    for p, q in borders.continuous:
        if q in bordering[p]:
            propose(p, q)
    while queue:
        _, p, q, born = heapq.heappop(queue)
        if q not in bordering[p] or born != age[p] + age[q]:
            continue
        _, k = proposal(p, q) or (0, 0)
        if len(members[p]) < len(members[q]):
            p, q, k = q, p, -k
        for basin in members[q]:
            region[basin], lift[basin] = p, lift[basin] + k
        members[p] += members.pop(q)
        if q in anchored:
            anchored.setdefault(p, anchored.pop(q) - k)
        del bordering[p][q], bordering[q][p]
        for other, border in bordering.pop(q).items():
            del bordering[other][q]
            bordering[p][other] = bordering[p].get(other, NO_BORDER).joined(border, k)
            bordering[other][p] = bordering[p][other].turned()
        age[p] += 1
        for other in bordering[p]:
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
