#!/usr/bin/python3
"""Kills runs with SIGKILL and restarts them, hundreds of times: nothing may be lost.

    tools/kill_test.py [KILLS] [--build BUILD_DIR] [--seed SEED]     # 200 kills, build/release

The scene and the comparison are those of tests/clients/kill_test.py, which does a few of them."""
import argparse
import subprocess
import sys
from pathlib import Path

root = Path(__file__).resolve().parent.parent
parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("kills", nargs="?", type=int, default=200)
parser.add_argument("--build", type=Path, default=root / "build/release", help="folder of a build")
parser.add_argument("--seed", type=int, default=1, help="of the random moments")
arguments = parser.parse_args()
if not (arguments.build / "dendrift").exists():
    print(f"kill_test: expected a program {arguments.build / 'dendrift'}, found none; build it, or name another --build",
          file=sys.stderr)
    sys.exit(2)
sys.exit(subprocess.call([sys.executable, root / "tests/clients/kill_test.py", arguments.build, root, str(arguments.kills),
                          str(arguments.seed)]))
