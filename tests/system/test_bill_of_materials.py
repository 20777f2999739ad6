"""The bundle's bill of materials, and what is made of the advisories on it."""

import hashlib
import importlib.util
import json
import zipfile
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

CI = Path(__file__).parents[2] / ".ci"
LOCK = CI.parent / "package-lock.json"


def program(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, CI / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def wheel(folder: Path, name: str, version: str, *lines: str) -> Path:
    path = folder / f"{name}-{version}-py3-none-any.whl"
    metadata = "\n".join(["Metadata-Version: 2.4", f"Name: {name}", f"Version: {version}", *lines, "", ""])
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{name}-{version}.dist-info/METADATA", metadata)
        archive.writestr(f"{name}/_vendor/other-1.0.dist-info/METADATA", "Name: other\n")
    return path


@pytest.fixture
def wheels(tmp_path: Path) -> Path:
    wheel(
        tmp_path,
        "toolpoint",
        "0.2.0",
        "License-Expression: Apache-2.0",
        "Requires-Dist: Numeric_Things<3,>=2.0",
        "Requires-Dist: only-on-windows; sys_platform == 'win32'",
        "Requires-Dist: pytest; extra == 'dev'",
    )
    wheel(
        tmp_path, "numeric_things", "2.1", "License: " + "whole text of it, " * 40, "Classifier: License :: MIT License"
    )
    return tmp_path


def test_each_wheel_is_a_component_with_its_digest_and_what_it_needs(wheels: Path) -> None:
    bill: dict[str, Any] = json.loads(program("bill_of_materials").bill_of_materials(wheels, LOCK))
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    assert bill["metadata"]["component"]["name"] == "toolpoint"
    component, uplot = bill["components"]
    assert uplot["purl"].startswith("pkg:npm/uplot@") and uplot["hashes"][0]["alg"] == "SHA-512"
    content = (wheels / "numeric_things-2.1-py3-none-any.whl").read_bytes()
    assert component["hashes"] == [{"alg": "SHA-256", "content": hashlib.sha256(content).hexdigest()}]
    assert component["purl"] == "pkg:pypi/numeric-things@2.1"
    assert component["licenses"] == [{"license": {"name": "MIT License"}}]
    alone: dict[str, list[str]] = {uplot["bom-ref"]: [], "numeric-things==2.1": []}
    needs = {one["ref"]: one.get("dependsOn", []) for one in bill["dependencies"]}
    assert needs == {"toolpoint==0.2.0": [uplot["bom-ref"], "numeric-things==2.1"], **alone}


def test_a_bundle_that_lacks_a_wheel_has_no_bill(wheels: Path) -> None:
    module = program("bill_of_materials")
    (wheels / "numeric_things-2.1-py3-none-any.whl").unlink()
    with pytest.raises(module.BillError, match="toolpoint needs numeric-things, of which there is no wheel"):
        module.bill_of_materials(wheels, LOCK)
    (wheels / "toolpoint-0.2.0-py3-none-any.whl").unlink()
    with pytest.raises(module.BillError, match="no wheel of toolpoint; run make bundle"):
        module.bill_of_materials(wheels, LOCK)


def test_make_bundle_writes_the_bill_and_its_checksum_covers_it() -> None:
    makefile = (CI.parent / "Makefile").read_text("utf-8")
    made = makefile.index("bill_of_materials.py dist/bundle/wheels package-lock.json dist/bundle/sbom.cdx.json")
    assert made < makefile.index("> SHA256SUMS")
    assert "\nbundle: $(VENV)/.installed-dev dist/bundle/wheels\n" in makefile, "the wheels are there before it"
    assert makefile.index("\ndist/bundle/wheels: ") < makefile.index("pip wheel")


def answer(*dependencies: dict[str, Any]) -> str:
    return json.dumps({"dependencies": dependencies, "fixes": []})


CLEAN = {"name": "a", "version": "1", "vulns": []}
KNOWN = {"name": "b", "version": "2", "vulns": [{"id": "PYSEC-1", "fix_versions": ["3"]}]}
UNASKED = {"name": "b", "skip_reason": "Dependency not found on PyPI and could not be audited: b (2)"}


@pytest.mark.parametrize(
    ("output", "said", "status", "words"),
    [
        (answer(CLEAN, CLEAN | {"name": "b"}), "", 0, "2 components, no known vulnerability"),
        (answer(CLEAN, KNOWN), "Found 1 known vulnerability", 1, "b 2: PYSEC-1, mended in 3"),
        (answer(KNOWN, {**UNASKED, "name": "a"}), "", 1, "PYSEC-1"),
        (answer(CLEAN, UNASKED), "", 0, "skipped: the index knows no advisories of 1 of 2 components"),
        ("", "ERROR: Max retries exceeded", 0, "skipped: no index of advisories can be reached"),
        ("", "", 0, "skipped: no index of advisories can be reached"),
    ],
)
def test_what_is_not_looked_up_is_never_called_clean(output: str, said: str, status: int, words: str) -> None:
    judged, sentence = program("audit").judge(1, output, said, {"a", "b"})
    assert judged == status and words in sentence
