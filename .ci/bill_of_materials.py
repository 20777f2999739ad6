"""Writes what a bundle brings along as a CycloneDX bill of materials: `bill_of_materials.py WHEELS LOCK OUTPUT`.

Each wheel of the folder is a component with version, licence and SHA-256; what it depends on is resolved among the
wheels, as the installer does, which sees nothing else. What the pages bring along, inside the product's wheel, is what
the lock file of npm names, without what only tests use.
"""

import base64
import hashlib
import json
import sys
import zipfile
from collections.abc import Collection
from dataclasses import dataclass
from email.message import Message
from email.parser import BytesHeaderParser
from pathlib import Path

from cyclonedx.contrib.license.factories import LicenseFactory
from cyclonedx.model import HashAlgorithm, HashType
from cyclonedx.model.bom import Bom
from cyclonedx.model.component import Component, ComponentType
from cyclonedx.output import make_outputter
from cyclonedx.schema import OutputFormat, SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator
from packageurl import PackageURL
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PRODUCT = "toolpoint"
VERSION = SchemaVersion.V1_6
LONGEST_LICENCE = 100
"""Some packages put the licence's whole text where its name belongs."""


class BillError(ValueError):
    """The wheels are no bundle; the text says why."""


@dataclass(frozen=True, slots=True)
class Wheel:
    """One wheel and what it says of itself."""

    path: Path
    metadata: Message

    @property
    def name(self) -> str:
        """Its name as package indexes write it."""
        return canonicalize_name(self.metadata["Name"])

    def component(self) -> Component:
        """Return it as a component."""
        version = self.metadata["Version"]
        digest = hashlib.sha256(self.path.read_bytes()).hexdigest()
        is_product = self.name == PRODUCT
        return Component(
            name=self.name,
            version=version,
            type=ComponentType.APPLICATION if is_product else ComponentType.LIBRARY,
            bom_ref=f"{self.name}=={version}",
            purl=PackageURL("pypi", None, self.name, version),
            licenses=[LicenseFactory().make_from_string(self._licence())] if self._licence() else [],
            hashes=[HashType(alg=HashAlgorithm.SHA_256, content=digest)],
        )

    def needs(self) -> list[str]:
        """Return the names of what it needs on this computer, without extras."""
        requirements = [Requirement(text) for text in self.metadata.get_all("Requires-Dist", [])]
        wanted = (one for one in requirements if one.marker is None or one.marker.evaluate({"extra": ""}))
        return [canonicalize_name(one.name) for one in wanted]

    def extras(self, there: Collection[str]) -> list[str]:
        """Return the names of what an extra of it needs and the bundle brings along."""
        names = {canonicalize_name(Requirement(text).name) for text in self.metadata.get_all("Requires-Dist", [])}
        return sorted(name for name in names - set(self.needs()) if name in there)

    def _licence(self) -> str:
        named = str(self.metadata["License-Expression"] or self.metadata["License"] or "")  # a Header where not ASCII
        if 0 < len(named) <= LONGEST_LICENCE and "\n" not in named:
            return named
        classes = [text for text in self.metadata.get_all("Classifier", []) if text.startswith("License ::")]
        return ", ".join(text.rpartition(":: ")[2] for text in classes)


def read_wheel(path: Path) -> Wheel:
    """Read a wheel's metadata; raises BillError."""
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA") and name.count("/") == 1]
        if len(names) != 1:
            raise BillError(f"{path}: {len(names)} files of metadata, not one: this is no wheel")
        return Wheel(path, BytesHeaderParser().parsebytes(archive.read(names[0])))


def of_the_pages(lock: Path) -> list[Component]:
    """Return what a lock file of npm names for use."""
    packages = json.loads(lock.read_text(encoding="utf-8"))["packages"]
    made = []
    for place, one in packages.items():
        if not place or one.get("dev"):
            continue
        name, version = place.rpartition("node_modules/")[2], one["version"]
        digest = base64.b64decode(one["integrity"].removeprefix("sha512-")).hex()
        made.append(
            Component(
                name=name,
                version=version,
                type=ComponentType.LIBRARY,
                bom_ref=f"npm {name}=={version}",
                purl=PackageURL("npm", None, name, version),
                licenses=[LicenseFactory().make_from_string(one["license"])],
                hashes=[HashType(alg=HashAlgorithm.SHA_512, content=digest)],
            )
        )
    return made


def bill_of_materials(folder: Path, lock: Path) -> str:
    """Return the bill of all wheels in a folder, and of what the pages bring along, as JSON; raises BillError."""
    wheels = {wheel.name: wheel for wheel in map(read_wheel, sorted(folder.glob("*.whl")))}
    if PRODUCT not in wheels:
        raise BillError(f"{folder}: there is no wheel of {PRODUCT}; run make bundle")
    components = {name: wheel.component() for name, wheel in wheels.items()}
    bom = Bom()
    bom.metadata.component = components[PRODUCT]
    for name, wheel in wheels.items():
        if name != PRODUCT:
            bom.components.add(components[name])
        needed = wheel.needs()
        if missing := sorted(set(needed) - set(wheels)):
            raise BillError(f"{folder}: {name} needs {', '.join(missing)}, of which there is no wheel")
        needed += wheel.extras(wheels) if name == PRODUCT else []
        pages = of_the_pages(lock) if name == PRODUCT else []
        for one in pages:
            bom.components.add(one)
        bom.register_dependency(components[name], [*(components[one] for one in needed), *pages])
    text = make_outputter(bom, OutputFormat.JSON, VERSION).output_as_string(indent=2)
    if problem := JsonStrictValidator(VERSION).validate_str(text):
        raise BillError(f"the bill is not what CycloneDX {VERSION.to_version()} asks for: {problem}")
    return text + "\n"


def main() -> int:
    """Write the bill; return the exit status."""
    folder, lock, output = map(Path, sys.argv[1:])
    try:
        output.write_text(bill_of_materials(folder, lock), encoding="utf-8")
    except BillError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
