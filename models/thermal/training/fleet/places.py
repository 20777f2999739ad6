"""Where sensors of different machines sit, and which of them stand for each other: by component and part, not by ID.

The sensors of one part are taken to be spread along it in the order of their list. Where two machines have as many on
a part, they stand for each other one by one; where one has fewer, what the other has between them is interpolated.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.recordings.dataset import DatasetError
from models.records import FloatArray

COMMON_SHARE = 0.5
"""A type has the parts that more than this share of its machines have a sensor on."""
LEAST_MATCHED = 0.5
"""A machine must have sensors on the parts of this share of the type's sensors."""
MOST_NAMED = 6


@dataclass(frozen=True, slots=True, kw_only=True, order=True)
class Part:
    """A part of a machine that has temperature sensors."""

    component: str
    part: str
    label: str
    """Of its sensors; sensors with a label of their own have a place of their own. Empty: none."""

    def __str__(self) -> str:
        """Return it in words."""
        words = self.component if self.part in ("", "-") else f"{self.component}, {self.part}"
        return f"{words} ({self.label})" if self.label else words


def places_of_type(machines: Sequence[Sequence[Part]]) -> tuple[Part, ...]:
    """Return the part of each sensor of a type: as many on each part as most machines have.

    Raises DatasetError when the machines share too few sensors to be of one type.

    `machines`: the part of each sensor, machine by machine, in the order of their lists.
    """
    counts = [Counter(parts) for parts in machines]
    order = list(dict.fromkeys(part for parts in machines for part in parts))
    found: list[Part] = []
    for part in order:
        have = [count[part] for count in counts if count[part]]
        if len(have) > COMMON_SHARE * len(machines):
            found += [part] * Counter(have).most_common(1)[0][0]
    if not found:
        raise DatasetError(
            "the machines share no part with a sensor, so they are not of one type; name the same component and part "
            "for the same place in the configuration of each"
        )
    return tuple(found)


def matching(of_type: Sequence[Part], own: Sequence[Part], machine: str) -> FloatArray:
    """Return what each sensor of a type is read from on a machine.

    Result of shape (len(of_type), len(own)): rows sum to 1. A part without a sensor is read as the mean of the sensors
    of its component; without any, of all. Raises DatasetError when the machine has sensors on too few of the parts.

    `of_type`, `own`: the part of each sensor of the type, and of the machine. `machine`: its name, for the message.
    """
    places: dict[Part, list[int]] = {}
    for column, part in enumerate(own):
        places.setdefault(part, []).append(column)
    lacking = list(dict.fromkeys(part for part in of_type if part not in places))
    matched = sum(part in places for part in of_type)
    if matched < LEAST_MATCHED * len(of_type):
        named = "; ".join(str(part) for part in lacking[:MOST_NAMED])
        more = f"; and {len(lacking) - MOST_NAMED} more" if len(lacking) > MOST_NAMED else ""
        raise DatasetError(
            f"machine {machine}: it shares {matched} of the {len(of_type)} sensors of the type, too few to be of it; "
            f"it has none on: {named}{more}. Name the same component and part for the same place in its configuration"
        )
    found = np.zeros((len(of_type), len(own)))
    begun: Counter[Part] = Counter()
    total = Counter(of_type)
    for row, part in enumerate(of_type):
        if columns := places.get(part):
            found[row, columns] = _between(begun[part], total[part], len(columns))
            begun[part] += 1
        else:
            near = [column for column, other in enumerate(own) if other.component == part.component]
            found[row, near or list(range(len(own)))] = 1.0 / (len(near) or len(own))
    return found


def _between(index: int, count: int, have: int) -> FloatArray:
    """Return the shares of `have` sensors, spread along a part, at the place of one of `count` that are."""
    shares = np.zeros(have)
    place = (index + 1) / (count + 1) * (have + 1) - 1.0
    place = min(max(place, 0.0), have - 1.0)
    first = min(int(place + 1e-9), have - 1)
    rest = max(place - first, 0.0)
    shares[first] = 1.0 - rest
    if rest > 1e-9:
        shares[first + 1] += rest
    return np.asarray(shares / shares.sum())
