#!/usr/bin/python3
"""tools/slurm_test.py --quick with the programs of this build: every job script on a Slurm of its own. Skipped where
none can be started."""
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "lib"))
from support import BUILD, SOURCE, run

if "-fsanitize" in run("--version").out:
    print("skipped: programs with a sanitizer are too slow for its limits")
    sys.exit(77)
sys.exit(subprocess.run([sys.executable, SOURCE / "tools/slurm_test.py", BUILD, "--quick", "--no-install"]).returncode)
