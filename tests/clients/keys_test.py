#!/usr/bin/python3
"""docs/keys.md is what the program prints: every key, unit, default, range and meaning, to the letter."""
import difflib
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "lib"))
from support import BUILD, SOURCE, require, run, say

printed = run("--keys", "--markdown").out
require(printed.count("\n| `") > 40, f"the program prints no list of keys:\n{printed[:500]}")
page = SOURCE / "docs" / "keys.md"
committed = page.read_text(encoding="utf-8") if page.exists() else ""
changes = "\n".join(difflib.unified_diff(committed.splitlines(), printed.splitlines(), "docs/keys.md", "the program",
                                         lineterm="", n=0))
require(committed == printed, f"docs/keys.md is out of date; run\n  tools/make_keys_doc.sh {BUILD}\n{changes}")
say(f"docs/keys.md: {len(printed.splitlines())} lines, as printed")
