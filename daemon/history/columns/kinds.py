"""The kinds of record that are packed, column by column, as the schema's tables have them."""

from functools import partial

from daemon.history.columns.frames import Column, ColumnType, Kind


def _columns(type_: ColumnType, names: str) -> tuple[Column, ...]:
    return tuple(Column(name=name, type=type_) for name in names.split())


_integers = partial(_columns, ColumnType.INTEGER)
_numbers = partial(_columns, ColumnType.NUMBER)
_texts = partial(_columns, ColumnType.TEXT)
_mappings = partial(_columns, ColumnType.MAPPING)


def _relative(name: str) -> Column:
    return Column(name=name, type=ColumnType.INTEGER, relative_to="utc_ms")


CYCLES = Kind(
    name="temperature cycles",
    table="temperature_cycles",
    columns=(
        *_integers("utc_ms"),
        _relative("monotonic_ms"),
        *_integers("number duration_ms complete"),
        *_texts("faults"),
    ),
)
"""What a temperature cycle has beside its values."""

CNC = Kind(
    name="cnc",
    table="cnc_samples",
    columns=(
        *_integers("utc_ms"),
        _relative("monotonic_ms"),
        *_texts("mode run"),
        *_integers("alarm program sequence_number"),
        *_numbers("spindle_speed_rpm motor_temperature_degc"),
        *_numbers("clock_ms"),
        *_integers("power_on_count work_offset tool_number"),
        *_mappings("macros positions_mm"),
    ),
)

DISPLACEMENTS = Kind(
    name="displacements",
    table="displacements",
    columns=(*_integers("utc_ms"), *_mappings("um reasons"), *_texts("source")),
)

ESTIMATES = Kind(
    name="estimates",
    table="estimates",
    columns=(
        *_integers("utc_ms"),
        _relative("monotonic_ms"),
        *_texts("line"),
        _relative("cycle_utc_ms"),
        *_numbers("delay_us"),
        *_mappings("thermal_error_um band_um label_degc label_reference_degc"),
        *_integers("in_domain"),
        *_numbers("confidence"),
        *_texts("imputed model_id reference_id"),
    ),
)

WRITES = Kind(
    name="writes",
    table="writes",
    columns=(
        *_integers("write_id utc_ms"),
        _relative("monotonic_ms"),
        *_texts("cause person state reason"),
        *_mappings("requested_um compensation_um"),
        *_texts("enable limits_hit"),
        *_mappings("macros"),
        *_integers("outcome"),
        *_numbers("sequence"),
        *_texts("detail"),
        *_mappings("read_back applied_um"),
        *_numbers("outcome_after_ms cycle_age_ms cleansed_us estimated_us written_us read_back_us"),
        *_numbers("echoed_after_ms"),
    ),
)

KINDS = {kind.name: kind for kind in (CNC, DISPLACEMENTS, ESTIMATES, WRITES)}
"""The kinds whose rows are packed as one frame per hour; temperatures have chunks of their own."""

TEMPERATURES = "temperatures"
"""Name of the temperatures' chunks."""
