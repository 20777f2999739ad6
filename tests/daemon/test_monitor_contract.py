"""The API keeps to its own OpenAPI document: schemathesis asks whatever the document allows and what it forbids."""

import asyncio
import re
import sys
from pathlib import Path

from monitor_bench import accounts_file, monitor
from render_api import api_reference

EXAMPLES = 4
"""Of each operation in the fuzzing phase, beside what the coverage phase makes of every bound."""
NOT_ASKED = ("/api/v1/events", "/api/v1/export")
"""One never ends, the other is a file; each has tests of its own."""
CHECKS = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
    "response_schema_conformance",
    "negative_data_rejection",
    "unsupported_method",
)
LONGEST_S = 600.0


async def test_every_answer_is_as_the_openapi_document_says(tmp_path: Path) -> None:
    async with monitor(tmp_path, users=accounts_file(tmp_path, anna="engineer")) as bench:
        await bench.rig.active()
        await bench.rig.history.flushed()
        browser = bench.browser()
        await browser.login("anna")
        (cookie,) = browser.cookies.items()
        turning = asyncio.create_task(turn_for_ever(bench.rig))
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "schemathesis.cli", "run", f"http://127.0.0.1:{bench.port}/openapi.json"),
            *("--checks", ",".join(CHECKS), "--phases", "coverage,fuzzing", "--max-examples", str(EXAMPLES)),
            *("--header", f"Cookie: {cookie[0]}={cookie[1]}", "--header", f"X-CSRF-Token: {browser.csrf}"),
            *(word for path in NOT_ASKED for word in ("--exclude-path", path)),
            *("--exclude-method", "DELETE", "--seed", "1", "--no-color", "--request-timeout", "60"),
            cwd=tmp_path,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        try:
            async with asyncio.timeout(LONGEST_S):
                output, _ = await process.communicate()
        finally:
            turning.cancel()
            if process.returncode is None:
                process.kill()
                await process.wait()
        words = output.decode("utf-8", "replace")
        assert process.returncode == 0, words[-6000:]
        assert int(re.search(r"(\d+) generated", words)[1]) > 200


def test_the_reference_page_is_made_from_the_code() -> None:
    page = Path(__file__).parents[2] / "docs" / "reference" / "api.md"
    assert page.read_text("utf-8") == api_reference(), "run `make docs`"


async def turn_for_ever(rig) -> None:
    """Let the control task decide on what is asked of it."""
    while True:
        await rig.turn()
        await asyncio.sleep(0.01)
