"""Says what the tests in the virtual machine came to, from their JUnit file; exit code 0 if all passed.

python verdict.py RESULTS
"""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path


def outcome(case: ET.Element) -> str:
    """One of "passed", "skipped", "failure", "error"."""
    kinds = [child.tag for child in case if child.tag in ("failure", "error", "skipped")]
    return kinds[0] if kinds else "passed"


def times(cases: list[ET.Element]) -> Counter[str]:
    """Returns how long the tests of each file took, and of each backend under the contract, s."""
    took: Counter[str] = Counter()
    for case in cases:
        module = case.get("classname", "").split(".test_contract.")[0]
        backend = case.get("name", "").partition("[")[2].partition("-")[0].rstrip("]")
        took[f"{module} {backend}" if module == "tests.contract" else module] += float(case.get("time", 0))
    return took


def judge(results: Path) -> int:
    """Prints one line for each test that did not pass, and the counts; returns the exit code.

    A skipped test counts as failed: here is where these tests are to run.
    """
    if not results.is_file() or results.stat().st_size == 0:
        print("vm: no results: the virtual machine did not get as far as its tests, or hung in them")
        return 1
    cases = list(ET.parse(results).getroot().iter("testcase"))
    counts = Counter(outcome(case) for case in cases)
    for case in cases:
        if outcome(case) != "passed":
            message = next((child.get("message", "") for child in case if child.tag != "properties"), "")
            first = message.strip().splitlines()[0] if message.strip() else ""
            print(f"vm: {outcome(case)}: {case.get('classname')}::{case.get('name')}: {first:.200}")
    for what, seconds in sorted(times(cases).items(), key=lambda each: -each[1]):
        print(f"vm: {seconds:6.1f} s {what}")
    failed = len(cases) - counts["passed"]
    print(f"vm: {counts['passed']} passed, {failed} failed or skipped")
    if not counts["passed"]:
        print("vm: no test passed, so nothing was tested")
    return 0 if counts["passed"] and not failed else 1


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    sys.exit(judge(Path(sys.argv[1])))
