#!/usr/bin/python3
"""docs/equations.md and the comments in src/ agree (tools/check_equations.py), and the check sees when they do not."""
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

SOURCE = Path(sys.argv[2]).resolve()
TOOL = SOURCE / "tools" / "check_equations.py"
KERNEL = "src/physics/alloy_kernel.cpp"


def check(*words):
    done = subprocess.run([sys.executable, str(TOOL), *map(str, words)], cwd="/", capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


code, text = check()
if code != 0:
    sys.exit(f"FAILED: docs and code disagree\n{text}")
print(text.strip())

# Each change of a copy, in the code or on the page, must be found and named.
BREAKS = [
    (KERNEL, "Eq. (2):", "Eq. (99):", "Eq. (99) has no section"),  # also: the last mention of (2) in that file
    (KERNEL, "Eq. (2):", "Here", f"{KERNEL}, which does not mention Eq. (2)"),
    (KERNEL, "Eq. (2):", "Eqs. (2)\n// and (4):", "Eq. (4), but"),
    (KERNEL, "void phase_rate(", "void other_rate(", f"phase_rate, which {KERNEL} does not have"),
    ("src/physics/scales.cpp", "namespace dendrift", "// see eq. (1)\nnamespace dendrift", "does not name this file"),
    ("docs/equations.md", "(`phase_rate`,", "(`phase_speed`,", "names phase_speed"),
    ("docs/equations.md", f"`{KERNEL}` (`phase_rate`", "`src/physics/alloy.cpp` (`phase_rate`", "which does not exist"),
    ("docs/equations.md", "## Eq. (3)", "## Eq. (33)", "Eq. (3) has no section"),
    ("docs/equations.md", "## Eq. (4): orientation\n\nCode:", "## Eq. (4): orientation\n\nSource:", "neither"),
    ("docs/equations.md", "## Eq. (4): orientation\n\nCode:", "## Eq. (4): orientation\n\nNot in the code yet.\n\nSource:",
     "Eq. (4), of which"),
    ("docs/equations.md", "## Eq. (4): orientation\n\nCode:", "## Eq. (4): orientation\n\nNot in the code yet.\n\nCode:",
     "has a Code line and"),
]
for file, old, new, wanted in BREAKS:
    with tempfile.TemporaryDirectory(prefix="dendrift_test_") as folder:
        copy = Path(folder)
        shutil.copytree(SOURCE / "src", copy / "src")
        (copy / "docs").mkdir()
        shutil.copy(SOURCE / "docs" / "equations.md", copy / "docs")
        before = (copy / file).read_text(encoding="utf-8")
        if old not in before:
            sys.exit(f"FAILED: '{old}' is not in {file} any more; choose another change for this test")
        (copy / file).write_text(before.replace(old, new), encoding="utf-8")
        code, text = check(copy)
        if code != 1 or wanted not in text:
            sys.exit(f"FAILED: '{old}' -> '{new}' in {file}: exit code 1 and '{wanted}' expected, {code} found\n{text}")
print(f"{len(BREAKS)} disagreements, each found")
