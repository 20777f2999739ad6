"""The reference page of spindle files, made from their schema by `make docs`."""

from render_configuration import section_tables

from config.machine.blank import BlankTest, ToolLibrary
from config.machine.spindle import SpindleDescription, shipped_materials, shipped_spindles

HEAD = """\
# Spindle files

<!-- Made from the schema by `make docs`; edit the descriptions in config/machine/spindle.py, not here. -->

A YAML file describes a spindle for [`toolpoint dynamics`](commands.md): the shaft from the nose backwards, its
bearings, and what is clamped into it. Lengths and diameters are in mm, moduli in GPa, everything else in SI units;
the units stand in the names. Unknown keys are refused; every refusal names file, line, column and key.

A section's constants are given in one of four forms:

| form | keys |
|---|---|
| written out | `E_gpa`, `G_gpa`, `nu`, `density_g_cm3`, all four |
| a material | `material` |
| a mixture, spread uniformly (4-19, 4-23, 4-24) | `mixture`: material and volume ratio, which sum up to 1 |
| layers with their diameters (4-22, 4-23, 4-25) | `layers`, from the bore outwards |

Beside a material, a mixture or layers, `E_gpa`, `G_gpa`, `nu` and `density_g_cm3` override what follows from them.

A file that states with which rotary inertia its bearing properties were identified (`bearings_identified_with`)
must state its own setting (`rigid_rotary_inertia`); when the two differ, or `--rotary` makes them differ, every
result carries a warning.

The direct form, free at both ends without `bearings`:

    structural_damping: 0.0029
    segments:
      - {length_mm: 15.1, outer_mm: 89.0, inner_mm: 42.4, E_gpa: 200, G_gpa: 76.9, nu: 0.3, density_g_cm3: 7.85}
      - {length_mm: 211.0, outer_mm: 53.0, inner_mm: 32.3, material: steel, ring: {outer_mm: 85.0, material: steel}}
    bearings:
      - {group: '12', position_mm: 99.1, kt_n_per_m: 5.11e7, ct_ns_per_m: 198, kr_nm_per_rad: 2.96e5}
"""

SHIPPED = """\
## What ships

Instead of a file, the commands take the name of a spindle that ships:"""
MATERIALS = "Materials that ship (`origin` says which numbers are derived):"

BLANKS = """\
## A test on a blank

What [`toolpoint dynamics blank`](commands.md) reads first: a cylinder in the holder, hit at its tip and at a second
point ([how to](../how-to/one-impact-test-for-every-tool.md)).
"""
LIBRARY = """\
## A library of tools

What it reads second. The constants of a tool's material are given as those of a section: `material`, or all four.
"""


def spindle_reference() -> str:
    """Return the reference page in Markdown."""
    lines = HEAD.splitlines() + section_tables(SpindleDescription)
    lines += ["", *SHIPPED.splitlines(), ""]
    lines += [", ".join(f"`{name}`" for name in shipped_spindles()) + "."]
    lines += ["", MATERIALS, ""]
    lines += ["| name | E [GPa] | G_zx, G_zy [GPa] | nu | density [g/cm^3] | origin |", "|---|---|---|---|---|---|"]
    for name, told in shipped_materials().items():
        shear = f"{told.G_gpa:g}" if told.G_gpa else f"{told.G_zx_gpa:g}, {told.G_zy_gpa:g}"
        poisson = "not known" if told.nu is None else f"{told.nu:g}"
        lines.append(f"| `{name}` | {told.E_gpa:g} | {shear} | {poisson} | {told.density_g_cm3:g} | {told.origin} |")
    lines += ["", *BLANKS.splitlines(), *section_tables(BlankTest)]
    lines += ["", *LIBRARY.splitlines(), *section_tables(ToolLibrary)]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(spindle_reference(), end="")
