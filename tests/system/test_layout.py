"""The house rules that a reader counts on: folders, sizes, docstrings, and what the wheel holds."""

import ast
import json
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from source_trees import tree

ROOT = Path(__file__).parents[2]
PACKAGES = ("models", "drivers", "config", "daemon")
FOLDERS = {*PACKAGES, "systemd", "tests", "docs", ".ci"}
LONGEST_FUNCTION = 80
LONGEST_CLASS = 250
MOST_PARAMETERS = 8


def sources(*folders: str) -> Iterator[Path]:
    for folder in folders:
        yield from sorted(path for path in (ROOT / folder).rglob("*.py") if "node_modules" not in path.parts)


def functions(path: Path) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def test_top_level_folders() -> None:
    listed = subprocess.run(["git", "ls-files"], capture_output=True, text=True, check=False, cwd=ROOT)
    if listed.returncode != 0:
        pytest.skip("these sources are no git repository, so what belongs to them is unknown")
    assert {name.split("/")[0] for name in listed.stdout.splitlines() if "/" in name} == FOLDERS


def test_the_tests_that_are_given_out_first_are_there() -> None:
    named = re.findall(r'"(tests/[\w/.]+)', (ROOT / "tests/conftest.py").read_text("utf-8"))
    assert len(named) > 10
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_no_function_is_longer_than_a_screen_or_two() -> None:
    long = {
        f"{path.relative_to(ROOT)}:{function.lineno} {function.name}": size
        for path in sources(*PACKAGES, "tests", ".ci")
        for function in functions(path)
        if (size := (function.end_lineno or 0) - function.lineno + 1) > LONGEST_FUNCTION
    }
    assert not long


def classes() -> Iterator[tuple[str, ast.ClassDef]]:
    for path in sources(*PACKAGES):
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.ClassDef):
                yield f"{path.relative_to(ROOT)}:{node.lineno} {node.name}", node


def test_no_class_is_too_long_to_be_read_at_once() -> None:
    sizes = {where: (node.end_lineno or 0) - node.lineno + 1 for where, node in classes()}
    assert not {where: size for where, size in sizes.items() if size > LONGEST_CLASS}


def test_no_constructor_takes_more_than_a_few_parameters() -> None:
    counts = {
        where: len([*member.args.posonlyargs, *member.args.args, *member.args.kwonlyargs]) - 1
        for where, node in classes()
        for member in node.body
        if isinstance(member, ast.FunctionDef) and member.name == "__init__"
    }
    assert not {where: count for where, count in counts.items() if count > MOST_PARAMETERS}


def public_definitions(path: Path) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef]:
    for node in tree(path).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            if any(isinstance(each, ast.Name) and each.id == "overload" for each in node.decorator_list):
                continue  # a type of the function that follows
            yield node
            if isinstance(node, ast.ClassDef):
                for member in node.body:
                    if isinstance(member, ast.FunctionDef) and not member.name.startswith("_"):
                        yield member


def test_everything_public_in_models_says_what_it_is() -> None:
    silent = [
        f"{path.relative_to(ROOT)}:{node.lineno} {node.name}"
        for path in sources("models")
        for node in public_definitions(path)
        if not ast.get_docstring(node)
    ]
    modules = [str(path) for path in sources(*PACKAGES) if not ast.get_docstring(tree(path))]
    assert (silent, modules) == ([], [])


def test_models_do_no_input_or_output() -> None:
    forbidden = {"asyncio", "logging", "structlog", "time", "datetime", "socket", "sqlite3", "threading", "os"}
    found = set()
    for path in sources("models"):
        for node in ast.walk(tree(path)):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            found |= {f"{path.relative_to(ROOT)}: {name}" for name in names if name.split(".")[0] in forbidden}
    assert not found


def test_no_package_files_under_tests() -> None:
    assert not list((ROOT / "tests").rglob("__init__.py"))


def test_test_files_have_names_of_their_own() -> None:
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert len(set(names)) == len(names)


def test_no_other_distribution_owns_a_package_name() -> None:
    owners = packages_distributions()
    for package in PACKAGES:
        assert set(owners.get(package, ["toolpoint"])) == {"toolpoint"}, package


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    folder = tmp_path_factory.mktemp("wheel")
    built = subprocess.run(
        [
            sys.executable,
            "-m",
            "pip",
            "wheel",
            "--quiet",
            "--no-deps",
            "--no-build-isolation",
            "--wheel-dir",
            str(folder),
            str(ROOT),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    (path,) = folder.glob("toolpoint-*.whl")
    return zipfile.ZipFile(path)


def test_wheel_holds_the_four_packages_and_nothing_else(wheel: zipfile.ZipFile) -> None:
    names = wheel.namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == set(PACKAGES)
    sources_in_wheel = {name for name in names if name.endswith(".py")}
    assert sources_in_wheel == {str(path.relative_to(ROOT)) for path in sources(*PACKAGES)}


def test_wheel_holds_the_data_that_the_daemon_needs(wheel: zipfile.ZipFile) -> None:
    tracked = {
        str(path.relative_to(ROOT))
        for package in PACKAGES
        for pattern in ("*.yaml", "*.json", "*.sql", "*.nc")
        for path in (ROOT / package).rglob(pattern)
    }
    assert {"config/cfrpmt.yaml", "drivers/guard/guard.nc"} <= tracked
    assert tracked <= set(wheel.namelist())


def test_wheel_holds_the_charts_of_the_pages(wheel: zipfile.ZipFile) -> None:
    folder = "daemon/monitor/pages/vendor/"
    assert b"https://github.com/leeoniya/uPlot" in wheel.read(f"{folder}uPlot.js")
    assert b".uplot" in wheel.read(f"{folder}uPlot.css")
    assert b"MIT License" in wheel.read(f"{folder}uPlot-LICENSE.txt")


def test_the_lock_of_the_pages_names_versions_and_hashes_but_no_address() -> None:
    lock = json.loads((ROOT / "package-lock.json").read_text("utf-8"))
    packages = {name: facts for name, facts in lock["packages"].items() if name}
    assert all(facts["version"] and facts["integrity"].startswith("sha512-") for facts in packages.values())
    assert not [name for name, facts in packages.items() if "resolved" in facts]
