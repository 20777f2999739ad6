"""Every key of a configuration section with its path."""

from collections.abc import Iterator

from pydantic import BaseModel

from config.knobs import Knob, Shape, knobs


def walk(section: type[BaseModel], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Knob]]:
    """Yield every key below a section with its path; `[]` stands for a list item, `<name>` for a name."""
    for knob in knobs(section):
        here = (*path, knob.name)
        yield here, knob
        if knob.section is not None:
            item = {Shape.SECTIONS: ("[]",), Shape.NAMED_SECTIONS: ("<name>",)}.get(knob.shape, ())
            yield from walk(knob.section, (*here, *item))
