"""Which sensors of different machines stand for each other: by component and part, whatever their IDs."""

import numpy as np
import pytest

from models.recordings.dataset import DatasetError
from models.thermal.training.fleet.places import Part, matching, places_of_type

NOSE, RAM, BED = (
    Part(component=c, part=p, label="") for c, p in (("Spindle", "Nose"), ("Spindle", "Ram"), ("Bed", "-"))
)


def test_a_type_has_the_parts_and_as_many_sensors_on_each_as_most_machines_have() -> None:
    assert places_of_type([[NOSE, BED, BED], [NOSE, BED, BED], [BED, NOSE, RAM]]) == (NOSE, BED, BED)


@pytest.mark.parametrize("names", [("A", "B"), ("A", "B", "C")])
def test_machines_without_a_common_part_are_of_no_type(names: tuple[str, ...]) -> None:
    others = [[Part(component=name, part="-", label="")] for name in names]
    with pytest.raises(DatasetError, match="share no part with a sensor"):
        places_of_type(others)


def test_as_many_sensors_stand_for_each_other_one_by_one_whatever_comes_between() -> None:
    found = matching([NOSE, BED, BED], [BED, NOSE, BED], "mill")
    assert found.tolist() == [[0, 1, 0], [1, 0, 0], [0, 0, 1]]


def test_fewer_sensors_on_a_part_are_interpolated_between() -> None:
    found = matching([BED, BED, BED, NOSE], [BED, BED, NOSE], "mill")
    assert found[1].tolist() == [0.5, 0.5, 0.0]
    assert found[0] @ [1.0, 2.0, 9.0] < found[1] @ [1.0, 2.0, 9.0] < found[2] @ [1.0, 2.0, 9.0]
    assert np.allclose(found.sum(axis=1), 1.0)


def test_a_part_without_a_sensor_is_read_from_its_component() -> None:
    found = matching([NOSE, RAM, BED], [NOSE, BED, NOSE], "mill")
    assert found[1].tolist() == [0.5, 0.0, 0.5]


def test_a_machine_with_sensors_elsewhere_is_refused_with_what_it_lacks() -> None:
    with pytest.raises(
        DatasetError, match=r"machine lathe: it shares 1 of the 3 .* it has none on: Spindle, Nose; Bed"
    ):
        matching([NOSE, RAM, BED], [RAM], "lathe")
