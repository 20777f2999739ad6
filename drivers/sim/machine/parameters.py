"""Parameters of the simulated machine's thermal network, each with what it rests on.

Capacities follow from mass times specific heat (steel and cast iron 460, oil 1900, CFRP and resin
concrete about 1000 J/(kg K)); the published masses of the moving axes (710, 1190 and 490 kg) bound
the sums. Conductances follow from contact areas or were chosen, and those marked 'tuned' were then
adjusted until the published behaviour of the machine came out (see the tests of the plant).
"""

from typing import NamedTuple


class Node(NamedTuple):
    """One lump of the network."""

    capacity_kj_per_k: float
    basis: str


class Link(NamedTuple):
    """Heat conduction between two lumps, or from a lump to air."""

    first: str
    second: str
    w_per_k: float
    basis: str


NODES: dict[str, Node] = {
    "shaft_front": Node(1.77, "front half of the shaft without nose and rotor, 3 to 4 kg (CFRP and steel); tuned"),
    "shaft_rotor": Node(4.6, "10 kg of rotor and sleeve"),
    "shaft_rear": Node(1.4, "rear end of the shaft"),
    "nose": Node(0.964, "2.1 kg of steel at the spindle nose; tuned"),
    "bearing_front": Node(1.2, "four rings and balls, 2.6 kg; tuned"),
    "bearing_rear": Node(0.8, "one bearing, 1.7 kg"),
    "stator": Node(11.0, "24 kg of laminations and copper"),
    "housing_rear": Node(5.35, "12 kg of steel; tuned"),
    "housing_front": Node(5.35, "12 kg of steel; tuned"),
    "cast_rear_bottom": Node(21.3, "46 kg of cast iron; tuned"),
    "cast_rear_top": Node(10.2, "22 kg of cast iron; tuned"),
    "cast_middle_bottom": Node(21.3, "46 kg of cast iron; tuned"),
    "cast_middle_top": Node(10.2, "22 kg of cast iron; tuned"),
    "cast_front_bottom": Node(21.3, "46 kg of cast iron; tuned"),
    "cast_front_top": Node(10.2, "22 kg of cast iron; tuned"),
    "front_cover": Node(3.5, "7.5 kg of steel"),
    "ram_top": Node(65.2, "rolled steel pipes with CFRP plates, 100 kg; tuned"),
    "ram_bottom": Node(65.2, "rolled steel pipes with CFRP plates, 100 kg; tuned"),
    "test_bar": Node(0.937, "2 kg of steel; tuned"),
    "tool": Node(1.2, "2.6 kg of holder and tool"),
    "oil": Node(248.0, "130 kg of oil in tank and pipes; tuned"),
    "slider_left": Node(38.0, "third of a slider of cast aluminium and CFRP"),
    "slider_right": Node(38.0, "third of the slider"),
    "slider_bottom": Node(38.0, "third of the slider"),
    "z_motor": Node(5.0, "4.5 kW servo motor"),
    "z_coupling": Node(2.0, "coupling cover"),
    "saddle_front": Node(80.0, "part of a saddle of 480 kg (CFRP and aluminium)"),
    "saddle_back": Node(80.0, "part of the saddle"),
    "saddle_left": Node(55.0, "part of the saddle"),
    "saddle_right": Node(55.0, "part of the saddle"),
    "x_motor": Node(3.0, "2.5 kW servo motor"),
    "x_coupling": Node(2.0, "coupling cover"),
    "x_screw": Node(8.0, "ball screw, nut and stand"),
    "column_left": Node(250.0, "column plates filled with resin concrete"),
    "column_right": Node(250.0, "column plates filled with resin concrete"),
    "column_front": Node(130.0, "guide side of the column"),
    "column_top": Node(110.0, "top of the column"),
    "y_motor": Node(3.0, "2.7 kW servo motor"),
    "y_coupling": Node(2.0, "coupling cover"),
    "y_screw": Node(12.0, "ball screw, nut and stand"),
    "bed_front": Node(380.0, "bed filled with resin concrete"),
    "bed_left": Node(480.0, "bed filled with resin concrete"),
    "bed_right": Node(480.0, "bed filled with resin concrete"),
    "a_motor": Node(28.0, "trunnion with A-axis motor"),
    "a_counter": Node(22.0, "counter side of the trunnion"),
    "air_low": Node(22.0, "air and sheet metal of the enclosure, lower half"),
    "air_high": Node(22.0, "air and sheet metal of the enclosure, upper half"),
}

LINKS: tuple[Link, ...] = (
    Link("shaft_front", "nose", 8.0, "steel ring, 30 cm2 over 20 mm to 50 mm"),
    Link("shaft_front", "shaft_rotor", 1.6, "CFRP shaft conducts poorly"),
    Link("shaft_rotor", "shaft_rear", 1.6, "CFRP shaft conducts poorly"),
    Link("shaft_front", "bearing_front", 7.11, "four bearings, about 2 W/K each; tuned"),
    Link("shaft_rear", "bearing_rear", 3.0, "one bearing; tuned"),
    Link("shaft_rotor", "stator", 12.9, "air gap of the motor; tuned"),
    Link("bearing_front", "housing_front", 21.9, "fit of the outer rings; tuned"),
    Link("bearing_rear", "housing_rear", 6.0, "fit of the outer ring"),
    Link("stator", "housing_rear", 18.0, "shrink fit with the jacket between"),
    Link("stator", "housing_front", 10.0, "shrink fit with the jacket between"),
    Link("housing_rear", "housing_front", 12.0, "steel tube"),
    Link("housing_rear", "cast_rear_bottom", 4.53, "seat of the housing; tuned"),
    Link("housing_rear", "cast_rear_top", 3.43, "seat of the housing; tuned"),
    Link("housing_rear", "cast_middle_bottom", 3.62, "seat of the housing; tuned"),
    Link("housing_rear", "cast_middle_top", 3.43, "seat of the housing; tuned"),
    Link("housing_front", "cast_middle_bottom", 3.62, "seat of the housing; tuned"),
    Link("housing_front", "cast_middle_top", 3.43, "seat of the housing; tuned"),
    Link("housing_front", "cast_front_bottom", 4.53, "seat of the housing; tuned"),
    Link("housing_front", "cast_front_top", 4.3, "seat of the housing; tuned"),
    Link("cast_rear_bottom", "cast_middle_bottom", 8.0, "cast iron wall"),
    Link("cast_middle_bottom", "cast_front_bottom", 8.0, "cast iron wall"),
    Link("cast_rear_top", "cast_middle_top", 8.0, "cast iron wall"),
    Link("cast_middle_top", "cast_front_top", 8.0, "cast iron wall"),
    Link("cast_rear_bottom", "cast_rear_top", 1.06, "side walls; tuned"),
    Link("cast_middle_bottom", "cast_middle_top", 1.06, "side walls; tuned"),
    Link("cast_front_bottom", "cast_front_top", 1.06, "side walls; tuned"),
    Link("front_cover", "housing_front", 6.0, "bolted flange"),
    Link("front_cover", "cast_front_bottom", 2.0, "bolted flange"),
    Link("front_cover", "cast_front_top", 2.0, "bolted flange"),
    Link("front_cover", "nose", 0.6, "labyrinth"),
    Link("ram_top", "cast_rear_top", 6.88, "bolted joint; tuned"),
    Link("ram_top", "cast_middle_top", 6.88, "bolted joint; tuned"),
    Link("ram_bottom", "cast_rear_bottom", 6.88, "bolted joint; tuned"),
    Link("ram_bottom", "cast_middle_bottom", 6.88, "bolted joint; tuned"),
    Link("ram_top", "ram_bottom", 2.0, "pipes and plates"),
    Link("test_bar", "nose", 0.215, "taper shank, thin section behind it; tuned"),
    Link("tool", "nose", 0.20, "taper shank, holder"),
    Link("ram_bottom", "slider_left", 3.0, "linear guides"),
    Link("ram_bottom", "slider_right", 3.0, "linear guides"),
    Link("ram_top", "slider_bottom", 2.0, "linear guides"),
    Link("slider_left", "slider_bottom", 6.0, "cast aluminium"),
    Link("slider_right", "slider_bottom", 6.0, "cast aluminium"),
    Link("z_motor", "z_coupling", 3.0, "flange"),
    Link("z_coupling", "slider_bottom", 3.0, "flange"),
    Link("slider_bottom", "x_screw", 2.0, "nut"),
    Link("slider_left", "saddle_left", 2.5, "linear guides"),
    Link("slider_right", "saddle_right", 2.5, "linear guides"),
    Link("slider_bottom", "saddle_front", 2.5, "linear guides"),
    Link("saddle_front", "saddle_left", 8.0, "cast aluminium and CFRP"),
    Link("saddle_front", "saddle_right", 8.0, "cast aluminium and CFRP"),
    Link("saddle_back", "saddle_left", 8.0, "cast aluminium and CFRP"),
    Link("saddle_back", "saddle_right", 8.0, "cast aluminium and CFRP"),
    Link("x_motor", "x_coupling", 3.0, "flange"),
    Link("x_coupling", "saddle_left", 3.0, "flange"),
    Link("x_screw", "saddle_right", 2.0, "stand"),
    Link("saddle_back", "column_front", 4.0, "linear guides"),
    Link("saddle_back", "y_screw", 2.0, "nut"),
    Link("y_motor", "y_coupling", 3.0, "flange"),
    Link("y_coupling", "column_top", 3.0, "flange"),
    Link("y_screw", "column_front", 2.0, "stand"),
    Link("column_left", "column_front", 12.0, "plates"),
    Link("column_right", "column_front", 12.0, "plates"),
    Link("column_left", "column_top", 8.0, "plates"),
    Link("column_right", "column_top", 8.0, "plates"),
    Link("column_left", "bed_left", 12.0, "bolted joint"),
    Link("column_right", "bed_right", 12.0, "bolted joint"),
    Link("bed_left", "bed_front", 15.0, "resin concrete and plates"),
    Link("bed_right", "bed_front", 15.0, "resin concrete and plates"),
    Link("a_motor", "bed_left", 6.0, "bolted joint"),
    Link("a_counter", "bed_right", 6.0, "bolted joint"),
    Link("a_motor", "a_counter", 2.0, "cradle with CFRP plates"),
    Link("air_low", "air_high", 40.0, "circulation inside the enclosure"),
)

OIL_LINKS: tuple[Link, ...] = (
    Link("stator", "oil", 122.0, "jacket at 10 l/min; only while the pump runs; tuned"),
    Link("housing_rear", "oil", 57.8, "jacket; tuned"),
    Link("housing_front", "oil", 33.0, "jacket; tuned"),
    Link("cast_rear_bottom", "oil", 12.1, "oil passages in the lower half; tuned"),
    Link("cast_middle_bottom", "oil", 12.1, "oil passages in the lower half; tuned"),
    Link("cast_front_bottom", "oil", 12.1, "oil passages in the lower half; tuned"),
)
"""Present only while the chiller's pump runs."""

AIR_LINKS: dict[str, tuple[float, float]] = {
    "nose": (0.2, 0.0),
    "housing_rear": (0.638, 0.0),
    "cast_rear_bottom": (0.638, 0.3),
    "cast_rear_top": (0.956, 0.3),
    "cast_middle_bottom": (0.638, 0.3),
    "cast_middle_top": (0.956, 0.3),
    "cast_front_bottom": (0.638, 0.3),
    "cast_front_top": (0.956, 0.3),
    "front_cover": (0.479, 0.4),
    "ram_top": (3.88, 0.2),
    "ram_bottom": (3.88, 0.4),
    "test_bar": (2.26, 0.7),
    "tool": (0.7, 0.7),
    "slider_left": (3.88, 0.4),
    "slider_right": (3.88, 0.4),
    "slider_bottom": (2.91, 0.4),
    "z_motor": (2.0, 0.2),
    "z_coupling": (0.8, 0.2),
    "saddle_front": (9.0, 0.5),
    "saddle_back": (7.0, 0.3),
    "saddle_left": (6.0, 0.5),
    "saddle_right": (6.0, 0.5),
    "x_motor": (1.5, 0.5),
    "x_coupling": (0.8, 0.5),
    "x_screw": (1.5, 0.5),
    "column_left": (12.0, 0.4),
    "column_right": (12.0, 0.4),
    "column_front": (8.0, 0.4),
    "column_top": (7.0, 0.0),
    "y_motor": (1.5, 0.0),
    "y_coupling": (0.8, 0.0),
    "y_screw": (1.5, 0.3),
    "bed_front": (10.0, 1.0),
    "bed_left": (12.0, 1.0),
    "bed_right": (12.0, 1.0),
    "a_motor": (3.0, 0.8),
    "a_counter": (3.0, 0.8),
}
"""Conductance to the air inside the enclosure [W/K] (about 5 W/(m2 K) times area; spindle unit, ram, slider and
test bar tuned), and the share of it that goes to the lower half."""

OUTSIDE_LINKS: dict[str, float] = {
    "air_low": 45.0,
    "air_high": 55.0,
    "oil": 2.0,
    "column_left": 6.0,
    "column_right": 6.0,
    "bed_left": 12.0,
    "bed_right": 12.0,
    "bed_front": 6.0,
}
"""Conductance to the air of the hall [W/K]: enclosure walls and doors, tank, outer faces, foundation (chosen)."""
