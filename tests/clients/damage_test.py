#!/usr/bin/python3
"""Damaged checkpoints: flipped bytes everywhere, truncation, files that are none, newer and older formats. Always refused
with a clear message, never a crash; a folder gives its newest sound checkpoint, and output goes on without gap or overlap."""
import json
import random
import shutil
import sys
from pathlib import Path

import h5py
import numpy as np

sys.path.insert(0, str(Path(__file__).parent / "lib"))
from support import CORNER_CRYSTAL, checkpoint_bits, differences, read_csv, require, reseal, run, say, scratch

SCENE = """
[run]
end_time_tau0 = 100
max_steps = 31
""" + CORNER_CRYSTAL + """[output]
dir = "run"
diagnostics_every_tau0 = 0.3
plot_every_tau0 = 0.5
checkpoint_every_steps = 10
"""
NEWEST = "chk_0000030.h5"


def flipped(content, places):
    content = bytearray(content)
    for place in places:
        content[place] ^= 0x10
    return bytes(content)


class Damage:
    """Puts damaged files in the place of the newest checkpoint of a run and restarts from them."""

    def __init__(self, folder):
        self.folder = folder
        (folder / "scene.toml").write_text(SCENE)
        run("scene.toml", cwd=folder)
        self.path = folder / "run" / NEWEST
        self.good = self.path.read_bytes()
        self.count = 0

    def refused(self, content, text, ranks=0):
        """The file alone: exit code 4, a message with its name and the text, and only one."""
        self.path.write_bytes(content)
        result = run("scene.toml", "output.dir=other", "--restart", self.path, code=4, ranks=ranks, cwd=self.folder, timeout=30)
        require(result.err.count("dendrift: ") == 1 and NEWEST in result.err, f"one message with the file's name: {result}")
        require(text in result.err, f"'{text}' expected: {result}")
        require(not (self.folder / "other").exists(), f"something was written: {result}")
        self.path.write_bytes(self.good)
        self.count += 1


def places_of_datasets(path):
    with h5py.File(path) as file:
        found = {}
        file.visititems(lambda name, item: found.update({name: (item.id.get_offset(), item.id.get_storage_size())})
                        if isinstance(item, h5py.Dataset) else None)
    require({"leaves", "input", "fields/psi", "fields/c", "checksums/psi"} <= found.keys(), f"datasets {list(found)}")
    return found


def check_flips(damage):
    datasets = places_of_datasets(damage.path)
    for name, (offset, size) in datasets.items():
        text = f"damaged: field {name[7:]} has another checksum in leaf" if name.startswith("fields/") else "damaged"
        for place in (offset, offset + size // 2, offset + size - 1):
            damage.refused(flipped(damage.good, [place]), text)
    last = max(offset + size - 1 for name, (offset, size) in datasets.items() if name.startswith("fields/"))
    damage.refused(flipped(damage.good, [last]), "damaged", ranks=2)  # which rank 1 alone finds
    chance = random.Random(1)
    inside = [range(o, o + s) for o, s in datasets.values()]
    bookkeeping = [p for p in range(len(damage.good)) if not any(p in r for r in inside)]
    for place in chance.sample(bookkeeping, 20):
        damage.refused(flipped(damage.good, [place]), "")
    damage.refused(flipped(damage.good, chance.sample(bookkeeping, 200)), "")
    damage.refused(bytes(512) + damage.good[512:], "damaged: its seal")
    damage.refused(damage.good + b"more", "damaged")
    say(f"flipped bytes in {len(datasets)} datasets and between them: {damage.count} files refused")


def check_truncation(damage):
    for i in range(50):
        damage.refused(damage.good[:len(damage.good) * i // 50], "empty" if i == 0 else "truncated" if i > 5 else "")
    say("an empty file, and 49 truncated ones: refused")


def check_other_files(damage):
    folder = damage.folder
    for plotfile in sorted((folder / "run").glob("plt_*.hdf"))[:2]:
        damage.refused(plotfile.read_bytes(), "not a checkpoint of Dendrift")
    damage.refused(b"this is not HDF5\n", "")
    damage.refused(damage.good.replace(b"\nformat 2\n", b"\nformat 3\n", 1), "checkpoint format 3, of a newer version")
    edited = folder / "edited.h5"
    edited.write_bytes(damage.good)
    with h5py.File(edited, "r+") as file:
        file.attrs.modify("format", np.int32(7))
    reseal(edited)
    damage.refused(edited.read_bytes(), "checkpoint format 7, of a newer version")
    # Format 1 had no seal and no checksums; it is read still.
    with h5py.File(damage.path) as new, h5py.File(edited, "w") as old:
        for name in ("fields", "leaves", "input", "numbers"):
            new.copy(name, old)
        for name, value in new.attrs.items():
            old.attrs[name] = value
        old.attrs["format"] = np.int32(1)
    result = run("scene.toml", "output.dir=old", "--restart", edited, cwd=folder)
    require("no checksums" in result.out, f"a checkpoint of format 1: {result}")
    shutil.rmtree(folder / "old")
    say("plotfiles, garbage, newer formats: refused; format 1: read")


def outputs(folder):
    """What a run leaves, without wall-clock times and owners of blocks."""
    header, rows = read_csv(folder / "diagnostics.csv")
    wall = header.index("wall_s")
    found = {"diagnostics.csv": [r[:wall] + r[wall + 1:] for r in rows]}
    for name in ("tips.csv", "grains.csv"):
        found[name] = read_csv(folder / name)[1]
    found["series"] = json.loads((folder / "plt.hdf.series").read_text())["files"]
    found["plotfiles"] = sorted(p.name for p in folder.glob("plt_*"))
    return found


def check_fallback(folder):
    damage = Damage(folder)
    good, out = folder / "good", folder / "run"
    shutil.copytree(out, good)
    expected, bits = outputs(good), checkpoint_bits(good / NEWEST)
    datasets = places_of_datasets(damage.path)
    cases = {f"{name} flipped": flipped(damage.good, [offset]) for name, (offset, size) in datasets.items()}
    cases["truncated"] = damage.good[:-1]
    cases["empty"] = b""
    cases["a plotfile"] = next(out.glob("plt_*.hdf")).read_bytes()
    cases["newer"] = damage.good.replace(b"\nformat 2\n", b"\nformat 3\n", 1)
    for i, (name, content) in enumerate(cases.items()):
        shutil.rmtree(out)
        shutil.copytree(good, out)
        damage.path.write_bytes(content)
        (out / "chk_0000040.h5.part").write_text("what a killed run leaves\n")
        result = run("scene.toml", "--restart", "run", ranks=2 if i % 5 == 0 else 0, cwd=folder, timeout=60)
        require(f"warning: passed over run/{NEWEST}: " in result.err, f"{name}: no warning: {result}")
        require("restart from run/chk_0000020.h5" in result.out, f"{name}: not from the older one: {result}")
        require(not differences(checkpoint_bits(out / NEWEST), bits), f"{name}: another state after the restart")
        found = outputs(out)
        require(found == expected, f"{name}: {[k for k in expected if found[k] != expected[k]]} differ after the restart")
        require(not list(out.glob("*.part")), f"{name}: left over: {list(out.glob('*.part'))}")
    # None sound: all are named
    for path in out.glob("chk_*.h5"):
        path.write_bytes(path.read_bytes()[:-1])
    result = run("scene.toml", "--restart", "run", code=4, cwd=folder)
    require("none of its checkpoints is sound" in result.err and result.err.count("truncated") == 4, f"none sound: {result}")
    say(f"a folder whose newest checkpoint is damaged, {len(cases)} ways: the older one, the same bits, lines and plotfiles")


damage = Damage(scratch())
check_flips(damage)
check_truncation(damage)
check_other_files(damage)
check_fallback(scratch())
