"""What the end-to-end tests share: running the programs, reading their files, saying what was found."""
import atexit
import csv
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path

import h5py
import numpy as np

BUILD, SOURCE = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()
PROGRAM = BUILD / "dendrift"
# Open MPI as root, on fewer cores than ranks (waiting ranks let others work); a program alone starts without a daemon.
# Other MPIs ignore these.
ENVIRONMENT = {
    "OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1", "OMPI_MCA_ess_singleton_isolated": "1",
    "OMPI_MCA_pml": "ob1", "OMPI_MCA_btl": "self,vader", "OMPI_MCA_osc": "^ucx",
    "OMPI_MCA_btl_vader_single_copy_mechanism": "none", "OMPI_MCA_mpi_yield_when_idle": "1",
    "OMP_WAIT_POLICY": "passive"}
# A folder of its own for session files: two such programs on one machine would remove each other's.
ENVIRONMENT["OMPI_MCA_orte_tmpdir_base"] = tempfile.mkdtemp(prefix="dendrift_mpi_")
os.chmod(ENVIRONMENT["OMPI_MCA_orte_tmpdir_base"], 0o1777)  # run(user=...) needs it as well
atexit.register(shutil.rmtree, ENVIRONMENT["OMPI_MCA_orte_tmpdir_base"], ignore_errors=True)
# A crystal in the corner of a small box, on three levels.
CORNER_CRYSTAL = """[mesh]
dim = 2
size_W0 = [64, 32]
root_blocks = [2, 1]
levels = 3
block_cells = 8
[[seed]]
position_W0 = [0, 0]
radius_W0 = 8
"""
CRASH_WORDS = ("terminate called", "Segmentation fault", "Assertion", "core dumped", "runtime error:",
               "AddressSanitizer", "Sanitizer:", "what():", "MPI_ABORT", "Signal:", "Traceback", "HDF5-DIAG")


class Failure(SystemExit):
    """Ends a test with its message and exit code 1, unless it is caught to go on with the next case."""


def fail(message):
    raise Failure(f"FAILED: {message}")


def require(condition, message):
    if not condition:
        fail(message)


def say(text):
    print(text, flush=True)


def scratch():
    """A temporary folder, removed at the end."""
    folder = Path(tempfile.mkdtemp(prefix="dendrift_test_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


class Result:
    def __init__(self, command, code, out, err):
        self.command, self.code, self.out, self.err = " ".join(map(str, command)), code, out, err

    def __str__(self):
        return f"{self.command}\n  exit code {self.code}\n  stdout: {self.out[-2000:]}\n  stderr: {self.err[-2000:]}"


def command_line(*words, ranks=0):
    """ranks 0: without mpirun."""
    launch = ["mpirun", "-n", ranks, "--oversubscribe", "--bind-to", "none"] if ranks else []
    return [str(w) for w in [*launch, PROGRAM, *words]]


def environment(threads=1):
    return {**os.environ, **ENVIRONMENT, "OMP_NUM_THREADS": str(threads)}


def run(*words, ranks=0, threads=1, code=0, cwd=None, timeout=300, user=None):
    """Runs the launcher; the exit code must be `code`, or one of them, and nothing may look like a crash."""
    command = command_line(*words, ranks=ranks)
    try:
        done = subprocess.run(command, cwd=cwd, env=environment(threads), stdin=subprocess.DEVNULL, timeout=timeout,
                              capture_output=True, text=True, errors="replace", user=user)
    except subprocess.TimeoutExpired:
        fail(f"no end after {timeout} s: {' '.join(command)}")
    result = Result(command, done.returncode, done.stdout, done.stderr)
    check_result(result, code)
    return result


def check_result(result, code):
    for word in CRASH_WORDS:
        require(word not in result.out + result.err, f"'{word}' in the output of {result}")
    codes = code if isinstance(code, tuple) else (code,)
    require(result.code in codes, f"exit code {' or '.join(map(str, codes))} expected: {result}")


def snapshot(folder):
    """Every name below a folder with its content and time of change: equal only if nothing was touched."""
    def state(path):
        if path.is_symlink() or not path.is_file():
            return "link" if path.is_symlink() else "folder" if path.is_dir() else "other"
        content = hashlib.sha256(path.read_bytes()).hexdigest() if os.access(path, os.R_OK) else "unreadable"
        return content, path.stat().st_mtime_ns
    return {str(p.relative_to(folder)): state(p) for p in sorted(Path(folder).rglob("*"))}


def read_csv(path):
    """Header and rows as texts, so that a comparison is one of bits."""
    with open(path, newline="") as file:
        rows = list(csv.reader(file))
    require(rows, f"{path} is empty")
    require(all(len(r) == len(rows[0]) for r in rows), f"{path}: lines with another number of columns than the header")
    return rows[0], rows[1:]


def column(path, name, kind=float):
    header, rows = read_csv(path)
    return [kind(r[header.index(name)]) for r in rows]


def checkpoint_bits(path):
    """Names, shapes, types and bytes of everything in a checkpoint that is state: attributes of the root and of
    /numbers, /leaves, /fields. The text of the input is left out: it names the output folder."""
    bits = {}
    with h5py.File(path) as file:
        require("leaves" in file and len(file["fields"]) > 0, f"{path} holds no leaves or no fields")
        for owner in ("/", "numbers"):
            for name, value in file[owner].attrs.items():
                bits[f"{owner} {name}"] = (np.shape(value), np.asarray(value).tobytes())
        for name in ("leaves", *(f"fields/{f}" for f in file["fields"])):
            data = file[name][()]
            bits[name] = (data.shape, str(data.dtype), data.tobytes())
            require(np.isfinite(data).all(), f"{path}: {name} is not finite")
    return bits


def reseal(path):
    """Makes a checkpoint that was edited look sound: checksums of every leaf, then the seal in front of the HDF5 data. Computed
    here with zlib from what docs/architecture.md says, so that it also tests what the program computes."""
    path = Path(path)
    with h5py.File(path, "r+") as file:
        for name, field in file.get("fields", {}).items():
            leaves = len(file["checksums"][name])
            file["checksums"][name][...] = [zlib.crc32(v.tobytes()) for v in field[()].reshape(leaves, -1)]
    with h5py.File(path) as file:
        room = file.userblock_size
        values = sorted((d.id.get_offset(), d.id.get_storage_size()) for d in file.get("fields", {}).values())
    content = path.read_bytes()
    checksum, at = 0, room
    for offset, size in [*values, (len(content), 0)]:
        checksum, at = zlib.crc32(content[at:offset], checksum), offset + size
    text = f"Dendrift checkpoint\nformat 2\nroom {room}\nbytes {len(content)}\n"
    text += "".join(f"values {offset} {size}\n" for offset, size in values) + f"checksum {checksum:08x}\n"
    text += f"seal {zlib.crc32(text.encode()):08x}\n"
    path.write_bytes(text.encode().ljust(room, b"\0") + content[room:])


def differences(a, b):
    """Names of what differs between two of the above."""
    return sorted(k for k in a.keys() | b.keys() if a.get(k) != b.get(k))
